"""Files are data: reading one runs no code but that of FILE.py:Class, which is announced.  Python's own audit events tell."""
from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from typer.testing import CliRunner

from olpm_bench.bench import environment, experiment_file
from olpm_bench.cli import app
from olpm_bench.scenes import SceneError
from olpm_bench.scenes.load import load
from olpm_bench.transport.guide import FORMAT
from olpm_bench.transport.settings import InputError

ROOT = Path(__file__).resolve().parents[2]
WATCH = """
import collections, dataclasses, json, os, sys
folder, *files = sys.argv[1:]
from olpm_bench.bench import environment, experiment_file, exr
environment.select_variant()
from olpm_bench.scenes import load as scene_load
from olpm_bench.transport.guide import Guide
seen, makers = [], (collections.__file__, dataclasses.__file__)     # of the methods of classes
def hook(event, arguments):
    if event == "exec":
        name = getattr(arguments[0], "co_filename", "?")
        if sys._getframe(1).f_code.co_filename in makers:
            return
        if name.startswith(folder) or not (os.path.isabs(name) or name.startswith("<frozen")):
            seen.append([event, name])
    elif event in ("os.system", "subprocess.Popen", "os.exec", "os.fork", "os.posix_spawn", "socket.connect", "pickle.find_class",
                   "shutil.rmtree", "os.remove", "os.rename", "os.mkdir"):
        seen.append([event, str(arguments)])
    elif event == "open" and (isinstance(arguments[1], str) and set(arguments[1]) & set("wax+")):
        seen.append([event, str(arguments)])
sys.addaudithook(hook)
for file in files:
    read = {".toml": experiment_file.load, ".npz": Guide.load, ".xml": scene_load.load, ".exr": exr.read_exr}
    try:
        read[os.path.splitext(file)[1]](exr.Path(file))
    except ValueError as error:
        print(error, file=sys.stderr)
print(json.dumps(seen))
"""
EVIL = "__import__('os').system('touch {ran}')"


def watched(folder: Path, *files: Path) -> tuple[list[list[str]], str]:
    """What reading files has done, and what it has said."""
    command = [sys.executable, "-c", WATCH, str(folder), *map(str, files)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT,
                          env={**os.environ, "PYTHONPATH": str(ROOT)})
    return json.loads(done.stdout.splitlines()[-1]), done.stderr


def experiment(folder: Path, kind: str, text: str = "") -> Path:
    data = {"title": f"T {text}", "description": text, "budget": {"spp": 1},
            "scene": [{"name": "cornell_box", "width": 4, "height": 4, "reference": "none"}],
            "method": [{"name": f"M {text}"}, {"name": "N", "representation": {"type": kind}}]}
    file = folder / f"{Path(kind).name.partition('.')[0]}.toml"
    file.write_text(tomli_w.dumps(data))
    return file


def test_reading_runs_nothing_but_what_is_announced(tmp_path):
    evil = EVIL.format(ran=tmp_path / "RAN")
    (tmp_path / "mine.py").write_text("class Mine:\n    pass\n")
    (tmp_path / "theirs.py").write_text(evil)
    meta = {"format": FORMAT, "representation": {"type": f"{tmp_path}/theirs.py:Theirs"}, "fraction": 0.5, "parallax": False,
            "particles": 1}
    np.savez(tmp_path / "guide.npz", meta=np.array(json.dumps(meta)))
    np.savez(tmp_path / "object.npz", meta=np.array([print], object))
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0"><bsdf type="{evil}"/><sensor type="perspective"/></scene>')
    files = [experiment(tmp_path, "jensen", evil), experiment(tmp_path, evil), tmp_path / "guide.npz", tmp_path / "object.npz",
             tmp_path / "scene.xml"]
    seen, said = watched(tmp_path, *files)
    assert seen == [] and "runs the code" not in said and not (tmp_path / "RAN").exists()
    assert "whose code is run only if Guide.load is told this type" in said

    seen, said = watched(tmp_path, *[experiment(tmp_path, "mine.py:Mine")] * 2)
    assert {tuple(event) for event in seen} == {("exec", str(tmp_path / "mine.py"))}
    assert said.count(f"olpm-bench: runs the code of {tmp_path / 'mine.py'}") == 1


def test_a_file_cannot_hide_by_its_name_that_it_is_run(tmp_path):
    (tmp_path / "mine\x1b[2K\r\x1b[1A.py").write_text("class Mine:\n    pass\n")
    file = tmp_path / "experiment.toml"
    experiment(tmp_path, "mine\x1b[2K\r\x1b[1A.py:Mine").rename(file)
    seen, said = watched(tmp_path, file)
    assert seen and f"olpm-bench: runs the code of {tmp_path}/mine\\x1b[2K\\r\\x1b[1A.py" in said and "\x1b" not in said


@pytest.fixture
def library(tmp_path) -> Path:
    """plugins/evil.so, which makes a file RAN when it is loaded."""
    if shutil.which("cc") is None or not sys.platform.startswith("linux"):
        pytest.skip("needs a C compiler, and Linux")
    (tmp_path / "plugins").mkdir()
    (tmp_path / "evil.c").write_text('#include <stdio.h>\n__attribute__((constructor)) static void run(void) '
                                     f'{{ fclose(fopen("{tmp_path / "RAN"}", "w")); }}')
    subprocess.run(["cc", "-shared", "-fPIC", "-o", tmp_path / "plugins" / "evil.so", tmp_path / "evil.c"], check=True)
    return tmp_path / "plugins" / "evil.so"


def scene(file: Path, *parts: str) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f'<scene version="3.0.0"><sensor type="perspective"/><emitter type="constant"/>{"".join(parts)}</scene>')
    return file


def far(library: Path) -> str:
    """A type that names the library from wherever Mitsuba's own plugins are."""
    return f"{'../' * 20}{library.with_suffix('').relative_to('/')}"


def test_a_library_beside_a_scene_is_not_loaded_as_a_plugin(tmp_path, library, monkeypatch):
    """Mitsuba looks for plugins in the scene's folder and in the current one before its own."""
    for kind in ("evil", "../plugins/evil", far(library)):
        with pytest.raises(SceneError, match=r"Mitsuba would run the code of .*evil\.so as a plugin"):
            load(scene(tmp_path / "scene.xml", f'<shape type="{kind}"/>'))
    with pytest.raises(SceneError, match="is the name of no plugin"):
        load(scene(tmp_path / "other" / "scene.xml", f'<shape type="{far(library)}"/>'))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneError, match=r"evil\.so as a plugin"):
        load("cornell_box")
    assert not (tmp_path / "RAN").exists()


def test_a_library_is_not_loaded_by_way_of_a_path_an_include_or_a_parameter(tmp_path, library):
    folder, kind = tmp_path / "scenes", far(library)
    for parts, message in [
            (['<path value=".."/>', '<shape type="evil"/>'], r"Mitsuba would run the code of .*evil\.so as a plugin"),
            (['<include filename="sub/b.xml"/>'], "is the name of no plugin"),
            (['<include filename="sub/d.xml"/>'], r"Mitsuba would run the code of .*evil\.so as a plugin"),
            ([f'<default name="k" value="{kind}"/><default name="k" value="sphere"/><shape type="$k"/>'], "of no plugin"),
            ([f'<default name="a" value="{kind}"/><default name="b" value="$a"/><shape type="$b"/>'], "of no plugin"),
            ([f'<default name="k" value="{kind[:-1]}"/><shape type="$k{kind[-1]}"/>'], "of no plugin")]:
        scene(folder / "sub" / "c.xml", f'<shape type="{kind}"/>')
        scene(folder / "c.xml", '<shape type="sphere"/>')
        (folder / "sub" / "b.xml").write_text('<scene version="3.0.0"><include filename="c.xml"/></scene>')
        (folder / "sub" / "d.xml").write_text('<scene version="3.0.0"><path value="../.."/></scene>')
        with pytest.raises(SceneError, match=message):
            load(scene(folder / "scene.xml", *parts))
    assert not (tmp_path / "RAN").exists()


def test_a_library_is_not_loaded_as_a_representation(tmp_path, library):
    """Python would load it by its suffix; the name holds that of a file of Python."""
    (tmp_path / "a.py:").mkdir()
    shutil.copy(library, tmp_path / "a.py:" / "evil.so")
    (tmp_path / "a.py:b").write_text("class Mine: pass")
    for kind in ("a.py:/evil.so:Mine", f"{tmp_path}/a.py:/evil.so:Mine", "a.py:b:Mine", "plugins/evil.so:Mine"):
        with pytest.raises(InputError, match="unknown representation"):
            experiment_file.load(experiment(tmp_path, kind))
    assert not (tmp_path / "RAN").exists()


def test_git_is_not_asked_about_the_current_folder(tmp_path, monkeypatch):
    """Where the software is installed, and the current folder is somebody's clone with a program to watch files."""
    if shutil.which("git") is None:
        pytest.skip("needs git")
    (tmp_path / "olpm_bench").mkdir()
    (evil := tmp_path / "evil.sh").write_text(f"#!/bin/sh\ntouch {tmp_path / 'RAN'}\n")
    evil.chmod(0o755)
    monkeypatch.chdir(tmp_path)

    def git(*words: str) -> None:
        subprocess.run(["git", *words], check=True, capture_output=True)
    for words in (["init"], ["add", evil.name], ["config", "core.fsmonitor", str(evil)], ["status"]):
        git(*words)
    if not (tmp_path / "RAN").exists():
        pytest.skip("this git runs no such program")
    (tmp_path / "RAN").unlink()
    installed = tmp_path / "site-packages" / "olpm_bench" / "bench" / "environment.py"
    monkeypatch.setattr(environment, "__file__", str(installed))
    assert environment.commit() is None and not (tmp_path / "RAN").exists()


def test_results_stay_in_their_folder_and_links_in_it_are_replaced(tmp_path, monkeypatch):
    """The file's name is that of the folder, and so must be one."""
    monkeypatch.chdir(tmp_path)
    for name in ("..toml", "...toml", "references.toml"):
        experiment(tmp_path, "jensen").rename(tmp_path / name)
        result = CliRunner().invoke(app, ["run", name, "--results", "results"])
        assert result.exit_code == 2 and "its results would go to the folder" in result.stderr
        assert not (tmp_path / "results").exists()
    file, outside = experiment(tmp_path, "jensen"), tmp_path / "precious.json"
    outside.write_text("precious")
    (tmp_path / "results" / "jensen").mkdir(parents=True)
    for name in ("env.json", "experiment.toml"):
        (tmp_path / "results" / "jensen" / name).symlink_to(outside)
    result = CliRunner().invoke(app, ["run", str(file), "--results", "results", "--only-scene", "cornell_box", "--shard", "9/9"])
    assert result.exit_code == 0, result.stderr
    assert outside.read_text() == "precious" and not (tmp_path / "results" / "jensen" / "env.json").is_symlink()
