"""Experiment files that are broken in any way: one line and exit code 2, or an experiment whose files stay in its folder."""
from __future__ import annotations

import copy
import io
import shutil
import stat
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from child import child
from hypothesis import assume, example, given
from hypothesis import strategies as st
from mutations import examples, mutated_bytes, names, tables
from typer.main import get_command

from olpm_bench.bench import experiment_file
from olpm_bench.bench.results import Results
from olpm_bench.cli import app

XML = '<scene version="3.0.0"><default name="resx" value="4"/></scene>'
SEEN = """<scene version="3.0.0"><emitter type="constant"/><shape type="sphere"/><sensor type="perspective">
<transform name="to_world"><lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/></transform></sensor></scene>"""
VALID = {
    "title": "Test", "seeds": 2, "description": "two", "baseline": "Path tracing",
    "budget": {"spp": 8, "checkpoints": 2},
    "scene": [{"name": "cornell_box", "width": 16, "height": 12, "max_depth": 4, "reference": "none",
               "parameters": {"light_size": 0.5}, "crops": [[0, 0, 8, 6]]},
              {"name": "room", "file": "room.xml", "width": 16, "height": 12, "overrides": {"resx": 8}, "reference": "folder"}],
    "integrator": {"roulette": "throughput", "rr_depth": 5, "max_depth": 7, "window": 0.5},
    "training": {"preset": "best", "passes": 2, "share": "auto", "photons": 1000, "gather": "binned"},
    "method": [{"name": "Path tracing"},
               {"name": "GMM", "representation": {"type": "gaussian_mixture", "components": 4},
                "sweep": {"training.photons": [1000, 10000]}},
               {"name": "Jensen", "representation": {"type": "jensen"}, "integrator": {"fraction": 0.5},
                "training": {"preset": "paper2014", "passes": 1}},
               {"name": "Mine", "representation": {"type": "mine.py:Mine", "width": 0.1}}],
    "claim": [{"better": "GMM, photons 1k", "worse": "Path tracing", "metric": "relative_variance", "ratio": 0.8}],
    "sweep": {"x": "setting", "y": ["l1", "bytes"]},
    "scale": {"small": {"seeds": 1, "budget": {"spp": 4}, "scene": {"width": 8, "height": 6}, "method": [{"name": "GMM"}]}},
}
TEXT = tomli_w.dumps(VALID).encode()
COMMAND = get_command(app)          # made once, which takes longer than to read a file
SEEN_SO_FAR: Counter[int] = Counter()           # exit codes


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where the files are; the current folder is beside it, and nothing else."""
    around = tmp_path_factory.mktemp("around")
    folder, current = around / "fuzz", around / "current"
    folder.mkdir()
    current.mkdir()
    (folder / "room.xml").write_text(XML)
    (folder / "seen.xml").write_text(SEEN)
    (folder / "folder").mkdir()
    (folder / "loop").symlink_to("loop")
    (folder / "mine.py").write_text("class Mine:\n    def __init__(self, width=0.2): self.width = width\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(current)
        yield folder
        print(f"{SEEN_SO_FAR.total()} experiment files: {SEEN_SO_FAR[0]} read, {SEEN_SO_FAR[2]} refused")   # with -rP


@pytest.fixture(scope="module")
def process():
    with child() as process:
        yield process


def listing(folder: Path) -> dict[Path, tuple[int, int] | None]:
    """All that is below a folder; of files, size and time of the last change."""
    found = {path: path.lstat() for path in folder.rglob("*")}
    return {path: None if stat.S_ISDIR(s.st_mode) else (s.st_size, s.st_mtime_ns) for path, s in found.items()}


def check(folder: Path, content: bytes, *options: str, name: str = "test.toml") -> int:
    """What a user sees who runs the file, and has the references made that are missing; returns the exit code."""
    (folder / name).write_bytes(content)
    before = listing(folder.parent)
    arguments = ["run", str(folder / name), "--dry-run", "--with-reference", "--results", str(folder / "results"), *options]
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as said:
        code = COMMAND.main(arguments, standalone_mode=False) or 0
    lines = [line for line in said.getvalue().split("\n") if line and "runs the code of" not in line]
    assert code in (0, 2), lines
    SEEN_SO_FAR[code] += 1
    if code:
        assert lines                # one for each reason
        for line in lines:
            assert line.startswith("olpm-bench: ") and len(line) < 2000 and line.isprintable(), line
    assert listing(folder.parent) == before
    return code


def run(process, folder: Path, data: dict[str, Any], stem: str) -> tuple[int, dict[str, Any]]:
    """The exit code of a dry run, and what the process says that runs the experiment; it has made nothing but its results."""
    code, before = check(folder, tomli_w.dumps(data).encode(), name=f"{stem}.toml"), listing(folder.parent)
    answer, results = process.ask("run", str(folder / f"{stem}.toml")), folder / "results"
    made = [path.name for path in results.iterdir()] if results.exists() else []
    shutil.rmtree(results, ignore_errors=True)
    assert made == ([] if code else [stem]) and listing(folder.parent) == before, (made, answer)
    return code, answer


@example(scene="../../up", method="/etc/passwd", stem="..x").via("names that are paths")
@examples(0.01)
@given(scene=names, method=names, stem=st.sampled_from(["test", "a b", "-", "nul", "é" * 60, "a.b", "[x]"]))
def test_what_is_run_writes_into_its_results_only(process, folder, scene, method, stem):
    data = {"title": method, "budget": {"spp": 1, "checkpoints": 1}, "integrator": {"max_depth": 3},
            "scene": [{"name": scene, "file": "seen.xml", "width": 4, "height": 4, "reference": "none"}],
            "method": [{"name": "Path tracing"}, {"name": method, "integrator": {"roulette": "none"}}]}
    code, answer = run(process, folder, data, stem)
    assert ("refused" if code else "ok") in answer, answer


@pytest.mark.parametrize("how", ["open('stray', 'w')", "os.open('stray', os.O_CREAT)", "os.mkdir('stray')", "os.remove('stray')",
                                 "os.rename('results', 'stray')", "shutil.rmtree('stray')"])
def test_what_is_touched_elsewhere_is_noticed(process, tmp_path, how):
    (tmp_path / "mine.py").write_text("import os, shutil\nclass Mine:\n    def __init__(self):\n"
                                      f"        os.chdir({str(tmp_path)!r})\n        try: {how}\n        finally: 1 / 0")
    data = {"title": "T", "budget": {"spp": 1}, "scene": [{"name": "cornell_box", "width": 4, "height": 4}],
            "method": [{"name": "Mine", "representation": {"type": "mine.py:Mine"}}]}
    (tmp_path / "test.toml").write_text(tomli_w.dumps(data))
    assert str(tmp_path / "stray") in process.ask("run", str(tmp_path / "test.toml")).get("traceback", "")


def stays_inside(folder: Path, name: str = "test.toml") -> None:
    """Every file that a run of it would write lies in the results folder."""
    root = (folder / "results").resolve()
    experiment = experiment_file.load(folder / name)
    own = (root / experiment.stem).resolve()
    assert own.parent == root and own.name != "references"
    results = Results(own)
    for spec in experiment.cells()[:20]:
        cell = results.cell_folder(spec.scene.name, spec.method.name, spec.seed)
        assert cell.resolve().relative_to(own / "cells").parts == cell.relative_to(own / "cells").parts
        assert (root / "references" / spec.reference_key).resolve().parent == root / "references"
        assert all(len(part.encode()) < 200 for part in (*cell.relative_to(own).parts, spec.reference_key))


def changed(where: str, value: Any) -> dict[str, Any]:
    """The valid experiment with one value changed: ``changed("scene.0.name", [])``."""
    data = copy.deepcopy(VALID)
    *path, last = (int(key) if key.isdigit() else key for key in where.split("/"))
    inner: Any = data
    for key in path:
        inner = inner[key]
    inner[last] = value
    return data


@example(data=changed("scene/0/name", []), scale=()).via("a name that cannot be hashed")
@example(data=changed("scene/0/name", "../../up"), scale=()).via("a name that is a path")
@example(data=changed("method/0/name", "x" * 3000), scale=()).via("a folder's name that is too long")
@example(data=changed("scene/0/name", "CON"), scale=()).via("a name that Windows keeps")
@example(data=changed("method/2/name", "a\x1b[31mb"), scale=()).via("a name that steers the terminal")
@example(data=changed("method/2/name", "$\\frac{1}$"), scale=()).via("a name that figures would take for mathematics")
@example(data=changed("title", "$x"), scale=()).via("so for the title")
@example(data=changed("method/2/name", "path Tracing"), scale=()).via("a folder for two where case is ignored")
@example(data=changed("scene/1/file", "a\x00b"), scale=()).via("a NUL in a path")
@example(data=changed("scene/1/file", "x" * 5000), scale=()).via("a path that is too long")
@example(data=changed("scene/1/reference", "loop"), scale=()).via("a link to itself")
@example(data=changed("method/3/representation/type", "\x00.py:Mine"), scale=()).via("a NUL in the path of code")
@example(data=changed("scene/0/parameters/light_size", 10**400), scale=()).via("a number beyond float64")
@example(data=changed("budget/spp", 10**400), scale=()).via("so for samples")
@example(data=changed("training/photons", 10**30), scale=()).via("a count beyond 32 bits")
@example(data=changed("method/1/sweep", {"training.photons": [10**400]}), scale=()).via("so in a sweep")
@example(data=changed("method/1/representation/first_fit", 10**30), scale=()).via("so in a representation")
@example(data=changed("description", "x" * 10**6), scale=()).via("a long text")
@examples(0.17)
@given(data=tables(VALID), scale=st.sampled_from([(), (), ("--scale", "small")]))
def test_tables_that_are_broken(folder, data, scale):
    if check(folder, tomli_w.dumps(data).encode(), *scale) == 0 and not scale:
        stays_inside(folder)


def in_a_moment(data: dict[str, Any]) -> dict[str, Any]:
    """Of a valid experiment what runs at once: its last scene, of another file, 4 x 4 pixels, and methods that learn nothing."""
    rest = {key: value for key, value in data.items() if key not in ("baseline", "claim", "scale", "sweep")}
    scene = {"name": data["scene"][-1]["name"], "file": "seen.xml", "width": 4, "height": 4, "reference": "none"}
    return rest | {"seeds": 1, "budget": {"spp": 1, "checkpoints": 1}, "scene": [scene],
                   "method": [method for method in data["method"] if "representation" not in method]}


@example(data=VALID).via("nothing is broken")
@examples(0.006)
@given(data=tables(VALID))
def test_tables_that_are_broken_and_run(process, folder, data):
    """Where they are no errors; a cell may fail."""
    assume(check(folder, tomli_w.dumps(data).encode()) == 0)
    code, answer = run(process, folder, in_a_moment(data), "test")
    assert "ok" in answer or (answer == {"refused": f"exit code {code or 1}"} and data != VALID), answer


@example(content=b"title = " + b"9" * 5000).via("more digits than Python reads")
@example(content=b"title = " + b"[" * 5000).via("lists too deep for tomllib")
@example(content=b"[" + b"a." * 5000 + b"a]").via("tables too deep for JSON")
@example(content=b"[[scene." + b"a." * 300 + b"a]]").via("tables too deep for pydantic")
@example(content=b"\xff\xfe").via("no UTF-8")
@examples(0.07)
@given(content=mutated_bytes(TEXT, dictionary=(b"[", b"]]", b"=", b'"', b'"""', b"1979-05-27T07:32:00Z", b"[scene]", b"\r")))
def test_bytes_that_are_broken(folder, content):
    if check(folder, content) == 0:
        stays_inside(folder)
