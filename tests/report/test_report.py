"""All of a report together: nothing is computed twice, the machines are named, and nothing of an earlier run stays."""
from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from small_experiment import edit

from olpm_bench.bench import gains, run, statistics
from olpm_bench.bench.results import Cell, Results
from olpm_bench.report import figures, sheet, sweeps


@pytest.fixture
def reported(finished, monkeypatch):
    """`run.report` of the finished experiment, with changes; returns the folder of its results."""
    folder = finished.results.folder.rename(finished.results.folder.with_name(finished.experiment.stem))
    monkeypatch.setattr(run, "references", lambda *_: {"door_ajar": finished.scenes[0].reference})

    def report(**changes) -> Path:
        run.report(finished.experiment.model_copy(update=changes), folder.parent)
        return folder
    return report


def test_everything_is_read_and_computed_once(reported, monkeypatch):
    calls: Counter[str] = Counter()

    def count(owner: object, name: str) -> None:
        original = getattr(owner, name)

        def counted(*args, **kwargs):
            calls[name] += 1
            return original(*args, **kwargs)
        monkeypatch.setattr(owner, name, counted)

    for owner, name in ((Results, "read_cell"), (Cell, "checkpoints"), (Cell, "image"), (statistics, "speed_up"),
                        (gains, "gain"), (gains, "estimate"), (sheet, "choose_crops"), (sheet, "relative_error")):
        count(owner, name)
    reported()
    cells, methods = 2 * 3, 2
    assert calls == {"read_cell": cells, "checkpoints": cells, "image": cells + methods, "speed_up": methods - 1,
                     "gain": 3 * methods, "estimate": 3 * methods, "choose_crops": 1, "relative_error": methods}


def test_captions_name_the_machines_that_made_the_cells(reported, monkeypatch, capsys):
    """And not the one of env.json, where `run` was called last."""
    folder, notes = reported(), []
    monkeypatch.setattr(figures, "save", lambda *_: [])
    for name in ("draw", "draw_gains"):
        monkeypatch.setattr(figures, name, lambda *arguments: notes.append(arguments[-1]))
    monkeypatch.setattr(sheet, "sheet", lambda found, blocks: notes.append(sheet.caption(found)) or [])
    monkeypatch.setattr(sweeps, "sweeps", lambda found: notes.append(sweeps._caption(found)) or [])
    machines = ({"cpu": "Abacus 3", "threads": 2, "variant": "llvm_ad_rgb"},
                {"cpu": "Abacus 1", "threads": 4, "variant": "cuda_ad_rgb"})
    for seed, machine in enumerate(machines):
        for path in (folder / "cells").glob(f"*/*/{seed}/cell.json"):
            edit(path, machine=machine)
    reported()
    said = "Abacus 1, 4 threads, cuda_ad_rgb; Abacus 3, 2 threads"
    assert len(notes) == 4 and all(note.endswith(f" {said}.") for note in notes)
    assert f"made on different machines, whose seconds do not compare: {said}\n" in capsys.readouterr().out
    if (folder / "report.html").exists():                       # with the extra report
        assert f"{said}. <code>olpm-bench run" in (folder / "report.html").read_text()


def test_what_an_earlier_run_has_drawn_does_not_stay(reported, finished):
    def files() -> set[str]:
        return {path.name for path in folder.iterdir() if path.is_file()}

    folder = reported()
    drawn, gains = files(), {"gains.png", "gains.pdf", "gains.svg"}
    assert {"figure.png", "sheet.png"} | gains <= drawn
    for name in ("sweep.png", "sweep.pdf", "gate.json"):
        (folder / name).write_text("of an earlier run")
    reported(method=finished.experiment.method[:1], seeds=[0])
    assert files() == drawn - gains | {"gate.json"}
