import pytest

from olpm_bench.suggest import closest


@pytest.mark.parametrize(("word", "meant"), [
    ("gausian_mixture", "gaussian_mixture"), ("gaussian-mixture", "gaussian_mixture"), ("Jensen", "jensen")])
def test_the_nearest_known_name_is_offered(word, meant):
    assert closest(word, ["cosine", "gaussian_mixture", "jensen"]) == f"; did you mean '{meant}'?"


@pytest.mark.parametrize("known", [[], ["cosine", "jensen"]])
def test_nothing_is_offered_where_no_known_name_is_near(known):
    assert closest("photons", known) == ""
