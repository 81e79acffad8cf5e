"""The commands: what they print, their exit codes, and one line for every expected mistake."""
from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import olpm_bench
from olpm_bench import cli
from olpm_bench.bench import config
from olpm_bench.bench.exr import read_exr
from olpm_bench.bench.reference_file import Reference, write_reference
from olpm_bench.cli import app

ROOT = Path(__file__).resolve().parents[2]
READERS = all(map(importlib.util.find_spec, ("jinja2", "simpleimageio", "figuregen", "typst")))     # the extra `report`
TOML = """
title = "Test"
seeds = 2
[budget]
spp = 4
checkpoints = 2
[[scene]]
name = "cornell_box"
width = 48
height = 36
max_depth = 3
[[method]]
name = "Path tracing"
[[method]]
name = "Roulette"
integrator = { roulette = "throughput" }
"""


def call(*arguments: object):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def process(*arguments: object, **environment: str) -> subprocess.CompletedProcess[str]:
    env = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    command = [sys.executable, "-m", "olpm_bench.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, env=env, timeout=120)


def complaint(result) -> str:
    """The one line of a refusal."""
    lines = [line for line in result.stderr.splitlines() if not line.startswith("olpm-bench: runs the code of ")]
    assert (getattr(result, "exit_code", None) or getattr(result, "returncode", None)) == 2, result.stderr
    assert len(lines) == 1 and lines[0].startswith("olpm-bench: "), result.stderr
    return lines[0]


@pytest.fixture
def experiment(tmp_path) -> Path:
    from olpm_bench.bench import experiment_file

    path = tmp_path / "test.toml"
    path.write_text(TOML)
    loaded = experiment_file.load(path)
    grey = np.full((36, 48, 3), 0.5, np.float32)
    reference = Reference(grey, grey + 0.01, grey, grey, {"spp_a": 1, "spp_b": 1})
    write_reference(tmp_path / "results" / "references" / loaded.reference_key(loaded.scene[0]), reference)
    return path


# ---------------------------------------------------------------- start-up

def test_help_loads_nothing_heavy():
    heavy = "drjit", "mitsuba", "numpy", "pydantic", "matplotlib", "colour", "skimage", "OpenEXR"
    code = f"import sys, olpm_bench.cli; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout.strip() == "[]"


def test_the_largest_seed_is_that_of_experiments():
    assert cli.MAX_SEED == config.MAX_SEED


def test_help_names_every_command():
    result = call("--help")
    assert result.exit_code == 0
    for name in ("run", "report", "gate", "submit", "reference", "metrics", "compare", "render", "inspect", "fit", "perf",
                 "list"):
        assert f"  {name} " in result.output


def test_list_shows_scenes_representations_and_experiments(monkeypatch):
    monkeypatch.chdir(ROOT)
    result = call("list")
    assert result.exit_code == 0
    for word in ("door_ajar", "gap = ", "gaussian_mixture", "    components: int = 8\n", "    first_fit: int | None = None\n",
                 "    resolution: int = 16\n", "experiments/quickstart.toml: Door ajar"):
        assert word in result.output


def test_list_shows_experiments_that_come_with_it_beside_ones_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("experiments").mkdir()
    Path("experiments/smoke.toml").write_text('title = "My own"')
    lines = call("list").output.splitlines()
    assert "  quickstart: Door ajar by 20 cm, equal time" in lines and "  experiments/smoke.toml: My own" in lines
    assert not any(line.startswith("  smoke:") for line in lines)


def test_the_version():
    result = call("--version")
    assert result.exit_code == 0 and result.stdout == f"olpm-bench {olpm_bench.__version__}\n"


@pytest.mark.parametrize("arguments, meant", [
    (["rn"], "Did you mean 'run'?"),
    (["run", "quikstart"], "; did you mean 'quickstart'?"),
    (["run", "quickstart", "--only-scene", "door-ajr"], "; did you mean 'door_ajar'?"),
    (["run", "quickstart", "--scene", "doorajar=x.xml"], "; did you mean 'door_ajar'?"),
    (["run", "quickstart", "--scale", "smal"], "; did you mean 'small'?"),
    (["inspect", "quickstart", "--pixel", "1,1", "--method", "Jansen"], "; did you mean 'Jensen'?"),
    (["check", "Gaussian-Mixtures"], "; did you mean 'gaussian_mixture'?"),
    (["check", "cosine", "--only", "densty"], "; did you mean 'density'?"),
    (["check", "jensen", "--set", "representation.resolutoin=3"], "; did you mean 'resolution'?"),
    (["fit", "--representation", "hay", "--samples", "a", "--heldout", "b"], "; did you mean 'hey'?"),
    (["render", "dor_ajar", "--method", "hey", "--out", "a.exr", "--spp", "1"], "; did you mean 'door_ajar'?"),
    (["render", "door_ajar", "--set", "scene.gpa=1", "--method", "hey", "--out", "a.exr", "--spp", "1"], "; did you mean 'gap'?"),
    (["render", "door_ajar", "--set", "trainin.passes=1", "--method", "hey", "--out", "a.exr", "--spp", "1"],
     "; did you mean 'training'?"),
])
def test_misspelt_names_are_mended(arguments, meant):
    result = call(*arguments)
    assert result.exit_code == 2 and meant in result.stderr and len(result.stderr) < 400


def test_list_survives_what_lies_in_the_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("experiments").mkdir()
    Path("experiments/deep.toml").write_text("a = " + 5000 * "[" + 5000 * "]")
    Path("experiments/steers.toml").write_text('title = "\\u001b[2J cleared"')
    result = call("list")
    assert result.exit_code == 0 and "deep.toml: cannot be read" in result.output
    assert "\x1b" not in result.output and "cleared" in result.output


# ---------------------------------------------------------------- run

def test_run_prints_the_table_and_writes_the_report_and_report_does_so_again(experiment, tmp_path, monkeypatch):
    result = call("run", experiment, "--results", tmp_path / "results")
    assert result.exit_code == 0, result.output
    assert "Path tracing" in result.stdout and "Roulette" in result.stdout
    folder = tmp_path / "results" / "test"
    for name in ("summary.json", "table.csv", "figure.png", "figure.pdf", "sheet.png", "experiment.toml", "env.json"):
        assert (folder / name).stat().st_size > 0
    rows = json.loads((folder / "summary.json").read_text())["rows"]
    assert [row["spp"] for row in rows] == [4, 4] and rows[0]["seeds"] == [0, 1]
    for extra in ("crops.pdf", "report.html"):
        assert (folder / extra).exists() == READERS

    from olpm_bench.bench import run, summary
    from olpm_bench.bench.results import Results

    asked = []
    monkeypatch.setattr(run, "report", lambda *arguments: asked.append(arguments))
    for arguments in ((folder,), (experiment, "--results", tmp_path / "results")):
        assert call("report", *arguments).exit_code == 0
        again, root = asked.pop()
        assert (root / again.path.stem).resolve() == folder.resolve()
        assert len(summary.complete_cells(again, Results(folder))) == 2


BOTH = TOML.replace("max_depth = 3", 'max_depth = 3\nreference = "none"').replace("[[method]]", """[[scene]]
name = "door_ajar"
width = 48
height = 36
max_depth = 3
reference = "none"
[[method]]""", 1)


def test_scenes_one_by_one_and_without_references(tmp_path):
    path, folder = tmp_path / "test.toml", tmp_path / "results" / "test"
    path.write_text(BOTH)
    run = ("run", path, "--results", tmp_path / "results")
    assert "4 of 4 cells to run" in call(*run, "--only-scene", "door_ajar", "--dry-run").stdout
    part = call(*run, "--only-scene", "door_ajar")
    assert part.exit_code == 0, part.output
    assert "Roulette" in part.stdout and "no summary and no figures yet; cells missing: 4 of cornell_box" in part.stdout
    assert (folder / "experiment.toml").read_text().count("[[scene]]") == 2 and not (folder / "summary.json").exists()
    whole = call(*run)
    assert whole.exit_code == 0, whole.output
    assert "no figure of L1 and no sheet: no scene has a reference" in whole.stdout
    assert {f.name for f in folder.iterdir() if f.is_file()} == {
        "experiment.toml", "env.json", "summary.json", "table.csv", *["report.html"] * READERS}
    assert "there is no variance and no gain, since an interval needs at least 3 seeds, and there are 2" in whole.stdout
    assert call(*run, "--only-scene", "door_ajar").stdout == whole.stdout      # all is complete: the report is whole
    assert "no scene 'room' in test.toml" in complaint(call(*run, "--only-scene", "room"))


def test_dry_run_runs_nothing(experiment, tmp_path):
    result = call("run", experiment, "--results", tmp_path / "results", "--dry-run")
    assert result.exit_code == 0 and "4 of 4 cells to run" in result.stdout and "GB" in result.stdout
    assert result.stdout.count("seed") == 4 and not (tmp_path / "results" / "test").exists()


def test_a_scale_is_run_and_named_in_commands_to_come(experiment, tmp_path):
    experiment.write_text(TOML + "[scale.small]\nseeds = 1\nscene = { width = 5, height = 4 }\n")
    results = tmp_path / "results"
    run = ("run", experiment, "--results", results, "--scale")
    assert "2 of 2 cells to run" in call(*run, "small", "--dry-run").stdout
    assert complaint(call(*run, "large")) == "olpm-bench: --scale large: test.toml has no [scale.large]; known: small"
    # 5 does not divide 48:
    assert f"test.toml --scale small --results {results}, or do without" in complaint(call(*run, "small"))
    assert not (results / "test-small").exists()


def test_a_failed_cell_exits_with_1(experiment, tmp_path, monkeypatch):
    from olpm_bench.bench import run

    def fail(*args, **kwargs):
        raise run.CellFailedError("3 pixels are NaN")

    monkeypatch.setattr(run, "measure", fail)
    result = call("run", experiment, "--results", tmp_path / "results")
    assert result.exit_code == 1 and "4 of 4 cells are not complete" in result.stderr
    assert "cornell_box / Path tracing / seed 0: 3 pixels are NaN" in result.stderr


def test_a_full_disk_is_one_line(experiment, tmp_path, monkeypatch):
    from olpm_bench.bench import run

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device", "results/cells/x")

    monkeypatch.setattr(run, "measure", full)
    assert complaint(call("run", experiment, "--results", tmp_path / "results")) == \
        "olpm-bench: results/cells/x: No space left on device"


def test_sigterm_exits_with_130_and_the_rest_is_run_later(experiment, tmp_path):
    results = tmp_path / "results"
    experiment.write_text(TOML.replace("spp = 4", "spp = 400"))
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "olpm_bench.cli", "run", str(experiment), "--results", str(results)]
    running = subprocess.Popen(command, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 100
        while not list(results.rglob("cell.json")) and running.poll() is None and time.monotonic() < deadline:
            time.sleep(0.02)
        running.send_signal(signal.SIGTERM)
        _, errors = running.communicate(timeout=60)
    finally:
        running.kill()
    assert running.returncode == 130 and "interrupted" in errors and "Traceback" not in errors
    complete = list(results.rglob("cell.json"))
    assert 1 <= len(complete) < 4
    assert not [f for f in results.rglob("*") if f.name == "lock" or ".tmp" in f.name]
    before = {f: f.stat().st_mtime_ns for f in complete}
    result = call("run", experiment, "--results", results)
    assert result.exit_code == 0, result.output
    assert {f: f.stat().st_mtime_ns for f in complete} == before and len(list(results.rglob("cell.json"))) == 4


# ---------------------------------------------------------------- reference

def test_reference_makes_what_run_asks_for(experiment, tmp_path):
    results = tmp_path / "elsewhere"
    assert f"olpm-bench reference {experiment}" in complaint(call("run", experiment, "--results", results))
    result = call("reference", experiment, "--results", results, "--seconds", 1)
    assert result.exit_code == 0 and "floor mean|A-B|/2 = " in result.stderr
    assert len(list((results / "references").glob("cornell_box-48x36-*/meta.json"))) == 1
    assert call("run", experiment, "--results", results, "--dry-run").exit_code == 0


# ---------------------------------------------------------------- render

def test_no_reference_to_make_is_said(tmp_path):
    (tmp_path / "test.toml").write_text(BOTH)
    done = call("reference", tmp_path / "test.toml", "--results", tmp_path / "results")
    assert done.exit_code == 0 and done.stdout.startswith("nothing to make") and not (tmp_path / "results").exists()


def test_render_writes_an_image_and_one_json_object(tmp_path):
    out = tmp_path / "box.exr"
    result = call("render", "cornell_box", "--method", "unguided", "--set", "scene.light_size=0.4", "--set",
                  "integrator.roulette=none", "--spp", 5, "--width", 16, "--height", 12, "--max-depth", 3, "--seed", 3,
                  "--out", out, "--json")
    assert result.exit_code == 0, result.output
    shown = json.loads(result.stdout)
    assert shown["spp"] == 5 and shown["seed"] == 3 and shown["parameters"]["light_size"] == 0.4
    assert shown["integrator"]["roulette"] == "none" and shown["integrator"]["max_depth"] == 3
    assert shown["versions"]["mitsuba"] and shown["train_seconds"] == 0 and shown["charged_seconds"] > 0
    parts, header = read_exr(out)
    assert set(parts) == {"mean", "variance", "count"} and parts["mean"].shape == (12, 16, 3)
    assert header["spp"] == 5 and (tmp_path / "box.png").stat().st_size > 0


def test_render_says_what_could_not_be_learnt(tmp_path, monkeypatch):
    from olpm_bench.bench import render_one

    monkeypatch.setattr(render_one, "render", lambda *_, **__: {"warnings": ["no camera path has met light"], "trained": 0.3})
    result = call("render", "cornell_box", "--method", "jensen", "--spp", 1, "--json", "--out", tmp_path / "x.exr")
    assert result.exit_code == 0 and "olpm-bench: no camera path has met light\n" in result.stderr
    assert "olpm-bench: only 30% of the surfaces" in result.stderr and json.loads(result.stdout)["trained"] == 0.3


def test_a_guide_is_saved_and_used_again(tmp_path):
    options = ("--method", "cosine", "--json", "--spp", 2, "--width", 16, "--height", 12, "--max-depth", 3)
    training = ("--set", "training.passes=1", "--set", "training.photons=500", "--set", "training.importons=100",
                "--set", "training.camera_passes=2", "--set", "training.camera_paths=200",
                "--set", "training.blend=false")
    guide = tmp_path / "g.npz"
    first = call("render", "cornell_box", *options, *training, "--out", tmp_path / "a.exr", "--save-guide", guide)
    assert first.exit_code == 0, first.output
    again = call("render", "cornell_box", *options, "--out", tmp_path / "b.exr", "--load-guide", guide)
    assert again.exit_code == 0, again.output
    trained, loaded = (json.loads(r.stdout) for r in (first, again))
    assert trained["train_seconds"] > 0 and loaded["train_seconds"] == 0 and loaded["records"] == trained["records"] > 0
    header = read_exr(tmp_path / "b.exr")[1]
    assert trained["training"]["photons"] == read_exr(tmp_path / "a.exr")[1]["training"]["photons"] == 500
    for said in (loaded, header):
        assert said["training"] is None and said["representation"] == {"type": "cosine"}
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0]["mean"], read_exr(tmp_path / "b.exr")[0]["mean"])
    other = call("render", "cornell_box", "--method", "jensen", *options[2:], "--out", tmp_path / "c.exr",
                 "--load-guide", guide)
    assert "type 'cosine'" in complaint(other)


RENDER = ("render", "cornell_box", "--spp", "1", "--out", "x.exr")


@pytest.mark.parametrize("arguments, words", [
    (("run", "missing.toml"), ["missing.toml", "no such file"]),
    (("run", "bad.toml"), ["unknown key 'sede' in bad.toml", "seeds"]),
    (("run", "good.toml", "--scene", "cornell_box"), ["--scene cornell_box: must be NAME=PATH"]),
    (("run", "good.toml", "--scene", "room=x.xml"), ["no scene 'room'", "known: cornell_box"]),
    (("run", "good.toml", "--results", "newer"), ["schema_version = 7 is newer"]),
    (("reference", "missing.toml"), ["no such file"]),
    (("report", "newer"), ["newer is no folder of results"]),
    (("report", "good.toml"), ["cornell_box", "olpm-bench reference good.toml"]),
    ((*RENDER, "--method", "gmm"), ["unknown representation 'gmm'", "gaussian_mixture"]),
    ((*RENDER, "--method", "unguided", "--seconds", "1"), ["give one of --seconds and --spp"]),
    ((*RENDER, "--method", "unguided", "--set", "passes=1"), ["--set passes=1", "KEY=VALUE"]),
    ((*RENDER, "--method", "unguided", "--set", "bench.passes=1"), ["unknown table 'bench'", "scene, integrator"]),
    ((*RENDER, "--method", "unguided", "--set", "training.passes=1"), ["--method with a representation"]),
    ((*RENDER, "--method", "cosine", "--set", "training.pases=1"), ["unknown key 'pases'", "passes"]),
    ((*RENDER, "--method", "cosine", "--set", "training.photons=-1"), ["photons = -1", ">= 1"]),
    ((*RENDER, "--method", "cosine", "--set", "representation.k=1"), ["no parameter 'k'"]),
    ((*RENDER, "--method", "gaussian_mixture", "--set", "representation.components=2.5"),
     ["components = 2.5", "a whole number"]),
    ((*RENDER, "--method", "jensen", "--set", "representation.type=hey"), ["representation.type=hey", "--method"]),
    (("fit", "--representation", "jensen", "--set", "representation.type=hey", "--samples", "s.npz", "--heldout", "h.npz"),
     ["representation.type=hey", "--representation"]),
    ((*RENDER, "--method", "jensen", "--load-guide", "g.npz", "--set", "representation.resolution=8"),
     ["--set representation.resolution", "trained already"]),
    ((*RENDER, "--method", "jensen", "--load-guide", "g.npz", "--set", "training.passes=8"),
     ["--set training.passes", "trained already"]),
    ((*RENDER, "--method", "cosine", "--set", "training.preset=['a']"), ["unknown preset ['a']", "best, paper2014"]),
    ((*RENDER, "--method", "unguided", "--set", "scene.light_size=7"), ["light_size = 7.0", "[0.01, 1.9]"]),
    (("run", "wide.toml", "--dry-run"), ["light_size = 9.0", "[0.01, 1.9]"]),
    (("run", "broken.toml"), ["broken.py", "cannot be loaded: SyntaxError"]),
    (("perf", "--scene", "no.xml"), ["no.xml", "no such file"]),
    ((*RENDER, "--method", "unguided", "--set", "scene.gap=1"), ["no parameter 'gap'", "light_size"]),
    ((*RENDER, "--method", "unguided", "--width", "0"), ["width", "0", "greater than or equal to 1"]),
    ((*RENDER, "--method", "unguided", "--threads", "0"), ["--threads 0", ">= 1"]),
    ((*RENDER, "--method", "unguided", "--save-guide", "g.npz"), ["--save-guide", "representation"]),
    ((*RENDER, "--method", "cosine", "--load-guide", "g.npz"), ["g.npz", "no such file"]),
    (("render", "no.xml", "--spp", "1", "--out", "x.exr", "--method", "unguided"), ["no.xml", "no such file"]),
    (("render", "no_scene", "--spp", "1", "--out", "x.exr", "--method", "unguided"), ["no_scene", "cornell_box"]),
    (("render", "cornell_box", "--spp", "1", "--out", "x.png", "--method", "unguided"), ["x.png", ".exr"]),
    (("render", "cornell_box", "--spp", "1", "--out", "no/x.exr", "--method", "unguided"), ["no folder no"]),
    ((*RENDER, "--method", "cosine", "--records-map", "./x.png"), ["the PNG beside it", "the same file"]),
    (("fit", "--representation", "gmm", "--samples", "s.npz", "--heldout", "h.npz"), ["unknown representation 'gmm'"]),
    (("fit", "--representation", "cosine", "--samples", "s.npz", "--heldout", "h.npz"), ["s.npz"]),
    (("fit", "--representation", "cosine", "--set", "training.passes=1", "--samples", "s.npz", "--heldout", "h.npz"),
     ["unknown table 'training'"]),
])
def test_bad_input_is_one_line_and_exit_code_2(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    Path("good.toml").write_text(TOML)
    Path("wide.toml").write_text(TOML.replace("max_depth = 3", "max_depth = 3\nparameters = { light_size = 9 }"))
    Path("broken.py").write_text("class Tilted(")
    Path("broken.toml").write_text(TOML + 'representation = { type = "broken.py:Tilted" }\n')
    Path("bad.toml").write_text(TOML.replace("seeds", "sede"))
    Path("newer/good").mkdir(parents=True)
    Path("newer/good/summary.json").write_text('{"schema_version": 7}')
    text = complaint(call(*arguments))
    for word in words:
        assert word in text


def test_bad_usage_exits_with_2_too():
    for arguments in (("run",), ("rnu", "x"), ("render", "cornell_box"), ("run", "x.toml", "--resutls", "y")):
        assert call(*arguments).exit_code == 2


@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_mono_polarized", "scalar_rgb", "nonsense"])
def test_other_variants_are_refused(tmp_path, monkeypatch, variant):
    monkeypatch.setenv("OLPM_BENCH_VARIANT", variant)
    monkeypatch.chdir(tmp_path)
    text = complaint(call(*RENDER, "--method", "unguided"))
    assert variant in text and "llvm_ad_rgb, cuda_ad_rgb" in text


def test_no_traceback_from_the_real_command(tmp_path):
    done = process("run", tmp_path / "missing.toml")
    assert "no such file" in complaint(done) and done.stdout == ""


def test_code_that_ends_the_process_is_no_success(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("ends.py").write_text("from representations.cosine import CosineLobe\n\nclass Ends(CosineLobe):\n"
                               "    def update(self, *args):\n        raise SystemExit(0)\n")
    Path("good.toml").write_text(TOML.replace("max_depth = 3", 'max_depth = 3\nreference = "none"')
                                 + 'representation = { type = "ends.py:Ends" }\n'
                                 "training = { passes = 1, photons = 1000, importons = 1000, camera_passes = 0 }\n")
    result = call("run", "good.toml")
    assert result.exit_code == 1 and "code that is not ours has ended the process" in result.stderr


def test_a_bug_keeps_its_traceback(monkeypatch):
    from olpm_bench import scenes

    monkeypatch.setattr(scenes, "names", lambda: 1 / 0)
    assert isinstance(call("list").exception, ZeroDivisionError)
    monkeypatch.setattr(scenes, "names", lambda: int("no number of the user's"))
    assert type(call("list").exception) is ValueError


@pytest.mark.parametrize("arguments", [
    (*RENDER, "--method", "unguided"),
    ("reference", "good.toml"),
    ("fit", "--representation", "cosine", "--samples", "s.npz", "--heldout", "h.npz")])
def test_an_error_of_mitsuba_is_one_line_and_exit_code_1(tmp_path, monkeypatch, arguments):
    """Also with the cause that Dr.Jit keeps to itself, and from `reason` alike in a cell of `run`."""
    from olpm_bench.bench import fit
    from olpm_bench.scenes import load

    def fail(*args, **kwargs):
        try:
            raise TypeError("unsupported operand")
        except TypeError as error:
            raise RuntimeError("dr.while_loop(): encountered\n  an exception") from error

    monkeypatch.setattr(load, "load", fail)
    monkeypatch.setattr(fit, "fit", fail)
    monkeypatch.chdir(tmp_path)
    Path("good.toml").write_text(TOML)
    result = call(*arguments)
    assert result.exit_code == 1
    assert result.stderr == "olpm-bench: dr.while_loop(): encountered an exception: unsupported operand\n"


@pytest.mark.parametrize("script", [False, True], ids=["python -m", "console script"])
def test_a_libllvm_that_crashes_is_one_line(tmp_path, script):
    """Both ways to start the command say so before Dr.Jit is loaded; an import as a library raises."""
    library = tmp_path / "libLLVM-15.so.1"
    library.touch()
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "DRJIT_LIBLLVM_PATH": str(library)}
    console_script = tmp_path / "olpm-bench"
    console_script.write_text("import sys\nfrom olpm_bench.cli import main\nsys.exit(main())\n")
    command = [str(console_script)] if script else ["-m", "olpm_bench.cli"]
    done = subprocess.run([sys.executable, *command, "list"], capture_output=True, text=True, env=environment)
    assert "is LLVM 15" in complaint(done) and "unset it" in done.stderr and done.stdout == ""
    imported = subprocess.run([sys.executable, "-c", "import olpm_bench"], capture_output=True, text=True, env=environment)
    assert imported.returncode == 1 and "LLVMError: DRJIT_LIBLLVM_PATH=" in imported.stderr.splitlines()[-1]
