"""The summary against a results folder whose errors are known."""
from __future__ import annotations

import csv
import dataclasses
import io
import json
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console
from small_experiment import edit

from olpm_bench.bench import config, experiment_file, finished, metrics, statistics, summary
from olpm_bench.bench.files import ResultError
from olpm_bench.bench.reference_file import Reference
from olpm_bench.bench.results import Results
from olpm_bench.transport.settings import IntegratorSettings

KEYS = ["scene", "method", "seeds", "l1", "l1_low", "l1_high", "mape", "smape", "relmse", "relmse_trimmed", "flip", "ssim_error",
        *(f"{name}{kind}{end}" for name in ("work_normalised_variance", "gain") for kind in ("", "_trimmed", "_mean")
          for end in ("", "_low", "_high")), "variance_passes", "undefined", "speed_up", "speed_up_low", "speed_up_high",
        "speed_up_bound", "mean", "mean_stderr", "charged_seconds", "overrun", "training_passes", "train_seconds",
        "render_seconds", "compile_seconds", "wait_fraction", "spp", "records", "bytes_per_record", "particles", "memory",
        "guided", "worst_speed_up", "apart", "bias_seen", "block_bias_seen", "noise_floor", "warnings"]
ERRORS = {"Slow": [0.4, 0.5, 0.9], "Fast": [0.2, 0.25, 0.45]}       # of seeds 4, 5, 7 after 16 s; falling as 1/sqrt(t)
TIMES = [1.0, 4.0, 16.0]


def folder(tmp_path, errors: dict[str, list[float]], seeds: list[int]) -> SimpleNamespace:
    experiment = experiment_file.parse({
        "title": "Known errors", "seeds": seeds, "budget": {"seconds": 16},
        "scene": [{"name": "door_ajar", "width": 6, "height": 5}],
        "method": [{"name": name} for name in errors]}, "known.toml", tmp_path)
    results = Results(tmp_path / "results" / "known")
    truth = np.ones((5, 6, 3), np.float32)
    for cell in experiment.cells():
        i = seeds.index(cell.seed)
        error = errors[cell.method.name][i]
        images = [truth + np.float32(error * np.sqrt(16 / t)) for t in TIMES]
        info = {"key": cell.key, "spp": 100 + i, "charged_seconds": 16.0, "training_passes": 3 + i, "train_seconds": 2.0 + i,
                "render_seconds": 14.0 - i, "compile_seconds": 5.0 if i == 0 else 0.0, "wait_fraction": 0.1 * i,
                "records": 1000 + i, "bytes_per_record": 256, "particles": 50_000, "image_passes": 10,
                "mean": 1 + error, "mean_stderr": 0.3}
        trace = [{"seconds": t, "spp": t} for t in TIMES]
        results.write_cell(cell.scene.name, cell.method.name, cell.seed, info, trace,
                           {"mean": images[-1], "variance": (0.1 * error) ** 2 * truth, "count": truth[..., 0]}, images,
                           cell.config())
    reference = Reference(truth, truth.copy(), truth, truth, {"spp_a": 1, "spp_b": 1})
    return SimpleNamespace(experiment=experiment, results=results, references={"door_ajar": reference})


@pytest.fixture()
def known(tmp_path):
    return folder(tmp_path, ERRORS, [4, 5, 7])


def summarised(known) -> dict:
    return summary.summarise(finished.read(known.experiment, known.results, known.references))


def test_rows_have_the_agreed_keys_in_the_order_of_the_toml(known):
    result = summarised(known)
    assert list(result) == ["schema_version", "rows", "flip_exposures"] and result["schema_version"] == 1
    assert [row["method"] for row in result["rows"]] == ["Slow", "Fast"]
    assert all(list(row) == KEYS for row in result["rows"])


def test_figures_over_seeds(known):
    row = summarised(known)["rows"][0]
    assert row["seeds"] == [4, 5, 7]
    assert row["l1"] == pytest.approx(0.5, rel=1e-6)
    assert row["l1_low"] == pytest.approx(0.41, rel=1e-6) and row["l1_high"] == pytest.approx(0.86, rel=1e-6)
    assert row["relmse"] == pytest.approx(0.25 / 1.01, rel=1e-6) == row["relmse_trimmed"]
    assert row["mean"] == pytest.approx(1.6) and row["mean_stderr"] == pytest.approx(0.3 / np.sqrt(3))
    variance = 16 * 0.01 * np.mean(np.square(ERRORS["Slow"])) / 1.001       # over the reference, which is 1
    for kind in ("", "_trimmed", "_mean"):
        assert row[f"work_normalised_variance{kind}"] == pytest.approx(variance, rel=1e-6)
        assert row[f"gain{kind}"] == row[f"gain{kind}_low"] == row[f"gain{kind}_high"] == 1
    assert row["variance_passes"] == 30 and row["undefined"] == []
    assert (row["train_seconds"], row["render_seconds"]) == (3, 13)
    assert (row["compile_seconds"], row["wait_fraction"]) == (5, 0.2)
    assert (row["spp"], row["records"], row["bytes_per_record"], row["particles"]) == (101, 1001, 256, 50_000)
    assert isinstance(row["spp"], int) and (row["charged_seconds"], row["overrun"]) == (16, 0)


def test_every_metric_is_a_median_over_seeds(known):
    row = summarised(known)["rows"][0]
    assert row["smape"] == pytest.approx(2 * 0.5 / 2.51, rel=1e-6) and row["mape"] == pytest.approx(0.5 / 1.01, rel=1e-6)
    assert 0 < row["flip"] < 1 and row["ssim_error"] is None        # smaller than the window of SSIM


def test_a_metric_that_fails_costs_its_column_and_is_named_below_the_table(known, monkeypatch, capsys):
    def fails(x, r):
        raise ValueError("no light")
    monkeypatch.setitem(metrics.METRICS, "flip", fails)
    result = summarised(known)
    assert [row["flip"] for row in result["rows"]] == [None, None] and result["rows"][0]["l1"] == pytest.approx(0.5)
    assert all(row["undefined"] == ["flip has no value: no light"] for row in result["rows"])
    summary.print_metrics(result, Console(width=200))
    assert capsys.readouterr().out.count("flip has no value: no light") == 1


@pytest.mark.parametrize("radiance", [0.0, 1e-9])
def test_a_black_or_dim_scene_ends_with_a_table(known, radiance, capsys):
    truth = np.full((5, 6, 3), radiance, np.float32)
    known.references["door_ajar"] = Reference(truth, truth.copy(), truth, truth, {"spp_a": 1, "spp_b": 1})
    result = summarised(known)
    assert (result["rows"][0]["flip"] is None) == (radiance == 0) == (result["flip_exposures"]["door_ajar"] is None)
    summary.print_table(result, Console(width=200))
    summary.print_metrics(result, Console(width=200))
    assert capsys.readouterr().out.count("Slow") > 1


def test_the_exposures_of_flip_are_those_of_the_reference(known):
    found = summarised(known)["flip_exposures"]["door_ajar"]        # of luminance 1
    assert found["start"] == found["stop"] == pytest.approx(np.log2(2.11887), abs=1e-3) and found["count"] == 2


def test_one_seed_has_no_variance_and_json_has_no_nan(tmp_path):
    known = folder(tmp_path, {"Alone": [0.5]}, [0])
    result = summarised(known)
    assert result["rows"][0]["work_normalised_variance"] is None and result["rows"][0]["gain"] is None
    reason = "there is no variance and no gain, since an interval needs at least 3 seeds, and there is 1"
    assert result["rows"][0]["undefined"] == [reason]
    summary.write(result, known.results)
    written = json.loads((known.results.folder / "summary.json").read_text(), parse_constant=pytest.fail)
    assert written == result
    row, = csv.DictReader(io.StringIO((known.results.folder / "table.csv").read_text()))
    assert list(row) == KEYS and row["work_normalised_variance"] == "" and float(row["l1"]) == result["rows"][0]["l1"]


def without_reference(known, **changes) -> SimpleNamespace:
    scenes = [scene.model_copy(update={"reference": config.NO_REFERENCE}) for scene in known.experiment.scene]
    experiment = known.experiment.model_copy(update={"scene": scenes, **changes})
    return SimpleNamespace(experiment=experiment, results=known.results, references={})


def test_a_scene_without_reference_has_no_errors_but_all_the_rest(known):
    rows, expected = summarised(without_reference(known))["rows"], summarised(known)["rows"]
    for row, full in zip(rows, expected, strict=True):
        errors = [*KEYS[KEYS.index("l1"):KEYS.index("ssim_error") + 1], "speed_up", "speed_up_low", "speed_up_high",
                  "worst_speed_up", "noise_floor"]
        assert [row[key] for key in errors] == [None] * len(errors)
        # Variances are relative to another mean, that of all cells.
        rest = [key for key in KEYS if key not in errors and not key.startswith("work_normalised_variance")]
        gains = [key for key in rest if key.startswith("gain")]
        assert {key: row[key] for key in rest if key not in gains} == {key: full[key] for key in rest if key not in gains}
        assert [row[key] for key in gains] == pytest.approx([full[key] for key in gains], rel=1e-4)
    assert finished.read(without_reference(known).experiment, known.results, {}).speed_ups == {"Fast": {}}
    console = Console(file=io.StringIO(), width=200)
    summary.print_table({"rows": rows}, console)
    shown = console.file.getvalue().splitlines()[2].split()
    assert shown[:7] == ["Slow", "-", "-", "-", "-", "1.00", "(1.00-1.00)"]


def test_images_without_error_have_no_curve_and_no_speed_up(tmp_path):
    """As of a room whose lamps have no power; the table still stands."""
    black = folder(tmp_path, {"Slow": [0.0, 0.0, 0.0], "Fast": [0.2, 0.25, 0.45]}, [4, 5, 7])
    found = finished.read(black.experiment, black.results, black.references)
    assert list(found.scenes[0].curves()) == ["Fast"] and np.isnan(found.speed_ups["Fast"]["door_ajar"].value)
    assert [row["l1"] for row in summarised(black)["rows"]] == [0, pytest.approx(0.25, rel=1e-5)]
    assert any("shares no L1 error" in line for line in summary.speed_up_lines(found.speed_ups, "Slow"))


def test_cells_that_exceed_their_budget_are_named(known, capsys):
    result = summarised(known)
    result["rows"][1]["overrun"] = 0.4
    summary.print_table(result)
    assert "door_ajar / Fast: took 40 % more time than its budget, as its passes take long; a longer" in capsys.readouterr().out


def test_warnings_of_training_are_told_once_with_every_table(known):
    """Of each method, and not only while its cells run; and the least share of records that guide."""
    found = finished.read(known.experiment, known.results, known.references)
    for cell, trained in zip(found.scenes[0].cells["Fast"], (0.9, 0.31, 0.4), strict=True):
        cell.info |= {"warnings": ["no camera path has met light"], "trained": trained}
    for cell in found.scenes[0].cells["Slow"]:
        cell.info |= {"warnings": [], "trained": None}
    result = summary.summarise(found)
    slow, fast = (row["warnings"] for row in result["rows"])
    assert slow == [] and fast[0] == "no camera path has met light" and len(fast) == 2
    assert fast[1].startswith("only 31% of the surfaces that the camera sees have records ")
    for show in (summary.print_table, summary.print_metrics):
        console = Console(file=io.StringIO())
        show(result, console)
        for warning in fast:
            assert console.file.getvalue().count(f"door_ajar / Fast: {warning}\n") == 1


def test_who_is_slower_to_some_error_is_named(known):
    rows = summarised(known)["rows"]
    assert [row["worst_speed_up"] for row in rows] == pytest.approx([1, 4], rel=1e-4)
    assert not [note for note in summary.notes(rows) if "compares worst" in note]
    known.experiment = known.experiment.model_copy(update={"baseline": "Fast"})
    rows = summarised(known)["rows"]
    assert any(note.startswith("door_ajar / Slow: 0.25x as fast as the baseline to the L1 error where it compares worst; see in")
               for note in summary.notes(rows))


def test_what_the_noise_of_the_reference_hides_is_not_compared(known):
    """Its halves differ by 0.3: below twice 0.15 errors are its own.  Slow falls as 2 / sqrt(t), Fast as 1 / sqrt(t) from 1 s."""
    true, off = known.references["door_ajar"], np.float32(0.15)
    known.references = {"door_ajar": dataclasses.replace(true, a=true.a + off, b=true.b - off)}
    scene, = finished.read(known.experiment, known.results, known.references).scenes
    assert scene.least_error == pytest.approx(0.3) and scene.worst_speed_ups["Fast"] == pytest.approx(4, rel=1e-4)
    rows = summarised(known)["rows"]
    assert [row["noise_floor"] for row in rows] == pytest.approx([0.15, 0.15])
    notes = [note for note in summary.notes(rows) if "noise" in note]
    assert notes == ["door_ajar / Fast: its L1 error is only 1.7 times the reference's noise, a part of it; go on with the "
                     "reference by olpm-bench reference, or trust the gain, which needs none"]


def test_gains_and_speed_ups_are_over_the_baseline(known):
    slow, fast = summarised(known)["rows"]
    assert [slow[key] for key in ("gain", "gain_low", "gain_high")] == [1, 1, 1]
    assert fast["gain"] == pytest.approx(slow["work_normalised_variance"] / fast["work_normalised_variance"])
    assert fast["gain_low"] <= fast["gain"] <= fast["gain_high"] and fast["training_passes"] == 4
    known.experiment = known.experiment.model_copy(update={"baseline": "Fast"})
    assert [row["gain"] for row in summarised(known)["rows"]] == pytest.approx([1 / fast["gain"], 1])
    found = finished.read(known.experiment, known.results, known.references).speed_ups
    assert list(found) == ["Slow"] and found["Slow"]["door_ajar"].value == pytest.approx(0.25, rel=1e-4)


def test_methods_whose_means_differ_are_told(known):
    def told() -> list[str]:
        return [note for note in summary.notes(summarised(known)["rows"]) if "standard errors" in note]
    assert told() == []
    for cell in (known.results.folder / "cells").glob("*/Fast/*/cell.json"):
        edit(cell, mean=4.0, mean_stderr=0.01)
    slow, fast = summarised(known)["rows"]
    assert slow["apart"] == 0 and fast["apart"] == pytest.approx((4 - slow["mean"]) / (0.3 / 3 ** 0.5), rel=0.2)
    assert told() == [f"door_ajar / Fast: its mean image is {fast['apart']:.0f} standard errors from the baseline's, in "
                      "the whole or in a block: one of the two is biased, or has too few samples to know its error"]


def test_what_a_cell_does_not_know_is_null(known):
    path = known.results.cell_folder("door_ajar", "Slow", 7) / "cell.json"
    edit(path, mean_stderr=None)
    for row in summarised(known)["rows"]:
        assert row["apart"] < 6 and row["bias_seen"] is None        # blocks know their error by the variance layer
        assert (row["mean_stderr"] is None) == (row["method"] == "Slow")


def test_a_missing_cell_is_named_with_the_command_that_makes_it(known):
    (known.results.cell_folder("door_ajar", "Fast", 5) / "cell.json").unlink()
    with pytest.raises(ResultError, match=r"Fast / seed 5 .* is missing; make it with: olpm-bench run .* --results"):
        summarised(known)


def test_a_cell_of_another_configuration_does_not_count(known):
    path = known.results.cell_folder("door_ajar", "Slow", 7) / "cell.json"
    edit(path, key="0123456789abcdef")
    with pytest.raises(ResultError, match=r"door_ajar / Slow / seed 7 .* is of another configuration"):
        summarised(known)


def test_metrics_take_cells_of_other_versions_but_not_of_other_settings(known):
    """A key that is out of date tells of other code; the settings are in the header of the image."""
    path = known.results.cell_folder("door_ajar", "Slow", 7) / "cell.json"
    key = json.loads(path.read_text())["key"]
    edit(path, key="0123456789abcdef")
    again = summary.summarise(finished.read(known.experiment, known.results, known.references, any_version=True))
    edit(path, key=key)
    assert again == summarised(known)
    for changes in ({"budget": config.Budget(seconds=17)}, {"integrator": IntegratorSettings(window=0.3)}):
        with pytest.raises(ResultError, match=r"door_ajar / Slow / seed 4 .* is of another configuration"):
            finished.read(known.experiment.model_copy(update=changes), known.results, known.references, any_version=True)


def test_speed_up_over_the_first_method_at_equal_error(known):
    found = finished.read(known.experiment, known.results, known.references).speed_ups
    assert list(found) == ["Fast"]
    interval = found["Fast"]["door_ajar"]
    assert interval.value == pytest.approx(4, rel=1e-4) and interval.low == pytest.approx(4, rel=1e-4)
    console = Console(file=io.StringIO(), width=120)
    summary.print_speed_ups(found, "Slow", console)
    assert console.file.getvalue() == "door_ajar / Fast: 4x (4-4) as fast as Slow at equal L1\n"


def test_speed_ups_over_scenes_are_averaged_where_all_are_known():
    known, bounded = statistics.Interval(2, 1.5, 2.5), statistics.Interval(8, np.nan, np.nan, ">")
    console = Console(file=io.StringIO())
    found = {"A": {"x": known, "y": known._replace(value=8)}, "B": {"x": known, "y": bounded}}
    summary.print_speed_ups(found, "PT", console)
    assert console.file.getvalue().splitlines() == [
        "x / A: 2x (1.5-2.5) as fast as PT at equal L1", "y / A: 8x (1.5-2.5) as fast as PT at equal L1",
        "A: 4x, geometric mean of 2 scenes",
        "x / B: 2x (1.5-2.5) as fast as PT at equal L1", "y / B: more than 8x as fast as PT at equal L1"]


def test_the_table_shows_every_method_and_flags_what_waited(known):
    console = Console(file=io.StringIO(), width=60)         # narrower than the table: nothing is cut off
    summary.print_table(summarised(known), console)
    text = console.file.getvalue()
    assert "door_ajar" in text and "0.500" in text and "0.410-0.860" in text
    assert "door_ajar / Slow: waited 20% of its time for a busy core" in text


@pytest.mark.parametrize(("value", "text"), [
    (0, "0"), (None, "-"), (float("nan"), "-"), (0.01234, "0.0123"), (1.5, "1.50"), (123.4, "123"), (12345, "12300"),
    (1e-7, "1.00e-07")])
def test_numbers_have_three_digits(value, text):
    assert summary.number(value) == text
