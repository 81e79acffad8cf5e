"""Where particles land: by room of a scene, and the figure over the passes of training."""
from __future__ import annotations

import numpy as np
import pytest

from olpm_bench.bench import inspect
from olpm_bench.report import figures, landings
from olpm_bench.transport.training import PassStatistics

ROOMS = ("dim room", "sunny room", "outside")


def passes(n: int = 4) -> list[PassStatistics]:
    """Of n passes the share of the first room rises from 1/4 to its half."""
    hits = {kind: [np.array([[10 + 10 * i / (n - 1), 4], [20.0 - 10 * i / (n - 1), 9], [10, 3]]) for i in range(n)]
            for kind in landings.KINDS}
    return [PassStatistics(i, n, regions={kind: h[i] for kind, h in hits.items()}) for i in range(n)] + [PassStatistics(n, n)]


def test_lines_are_shares_of_all_hits():
    with figures.style():
        figure = landings.draw(passes(), ROOMS)
    assert [axes.get_title() for axes in figure.axes] == list(landings.KINDS)
    first, *_, outside = figure.axes[0].get_lines()
    np.testing.assert_allclose(first.get_xydata()[[0, -1]], [[1, 0.25], [4, 0.5]])
    np.testing.assert_allclose(outside.get_ydata(), 0.25)
    (effective,) = {round(float(path.vertices[:, 1].max()), 9) for path in figure.axes[1].collections[0].get_paths()}
    assert effective == 0.1
    assert [text.get_text() for text in figure.legends[0].get_texts()] == [*ROOMS, "shaded: their effective number"]


@pytest.mark.parametrize("trained", [True, False])
def test_a_guide_from_a_file_has_no_passes_to_show(tmp_path, trained):
    learnt = {"GMM": inspect.Learnt(None, {}, "", passes() if trained else [])}
    written = inspect._by_room(learnt, ROOMS, tmp_path, "den")
    assert [path.name for path in written] == (["den_particles_GMM.png"] if trained else [])
    assert all(path.stat().st_size > 0 for path in written)
