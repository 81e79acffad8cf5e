"""Representations by name, by entry point, and from a file."""
from __future__ import annotations

import importlib.metadata
import subprocess
import sys
from pathlib import Path

import pytest

import representations
from representations.cosine import CosineLobe

OWN = '''
from representations.cosine import CosineLobe

class Tilted(CosineLobe):
    def __init__(self, tilt: float = 0.5) -> None:
        self.tilt = tilt
'''


def test_built_in_names() -> None:
    assert {"cosine", "gaussian_mixture", "hey", "jensen"} <= set(representations.names())
    assert representations.names() == sorted(representations.names())


@pytest.mark.parametrize("name", ["cosine", "gaussian_mixture", "hey", "jensen"])
def test_create(name: str) -> None:
    for verb in ("init", "update", "sample", "pdf"):
        assert callable(getattr(representations.create(name), verb))


def test_unknown_name() -> None:
    with pytest.raises(representations.RepresentationError,
                       match=r"unknown representation 'gmmm'; known: cosine, .*hey, jensen.*, or path/to/file\.py:ClassName"):
        representations.create("gmmm")


@pytest.mark.parametrize(("name", "parameters", "message"), [
    ("jensen", {"resolutoin": 8}, "representation 'jensen' has no parameter 'resolutoin'; known: resolution"),
    ("cosine", {"power": 8}, "representation 'cosine' has no parameter 'power'; known: none"),
    ("jensen", {"resolution": -1}, "representation 'jensen': resolution = -1: must be in 1"),
    ("jensen", {"resolution": "many"}, "representation 'jensen': resolution = 'many': must be a whole number"),
    ("jensen", {"resolution": True}, "resolution = True: must be a whole number"),
    ("gaussian_mixture", {"components": 2.5}, "representation 'gaussian_mixture': components = 2.5: must be a whole number"),
    ("gaussian_mixture", {"alpha": "abc"}, "alpha = 'abc': must be a number"),
    ("gaussian_mixture", {"alpha": False}, "alpha = False: must be a number"),
    ("hey", {"cones": 0}, "representation 'hey': cones = 0: must be in 1"),
])
def test_bad_parameters(name: str, parameters: dict, message: str) -> None:
    with pytest.raises(representations.RepresentationError, match=message):
        representations.create(name, **parameters)


def test_from_file(tmp_path: Path) -> None:
    file = tmp_path / "tilted.py"
    file.write_text(OWN)
    tilted = representations.create(f"{file}:Tilted", tilt=0.25)
    assert isinstance(tilted, CosineLobe) and tilted.tilt == 0.25


def test_from_file_that_lacks_it(tmp_path: Path) -> None:
    file = tmp_path / "tilted.py"
    with pytest.raises(representations.RepresentationError, match="there is no such file"):
        representations.create(f"{file}:Tilted")
    file.write_text(OWN)
    with pytest.raises(representations.RepresentationError, match="has no class 'Titled'"):
        representations.create(f"{file}:Titled")
    with pytest.raises(representations.RepresentationError, match="has no class '__doc__'"):
        representations.create(f"{file}:__doc__")


@pytest.mark.parametrize(("code", "message"), [
    ("class Tilted(", "SyntaxError: "), ("import no_such_module", "ModuleNotFoundError: No module named 'no_such_module'"),
    ("raise RuntimeError('two\\nlines')", "RuntimeError: two lines"),
    ("class Tilted: pass\nraise SystemExit(0)", "SystemExit: 0")])
def test_from_file_that_cannot_be_run(tmp_path: Path, code: str, message: str) -> None:
    file = tmp_path / "broken_file.py"
    file.write_text(code)
    with pytest.raises(representations.RepresentationError, match=f"broken_file.py cannot be loaded: {message}") as error:
        representations.create(f"{file}:Tilted")
    assert "\n" not in str(error.value) and "representation_broken_file" not in sys.modules


@pytest.mark.parametrize(("code", "message"), [
    ("class Tilted:\n    def __init__(self, tilt=0.5): {}['tilt']", "cannot be loaded: KeyError: 'tilt'"),
    ("class Tilted:\n    def __init__(self, tilt=0.5): assert tilt < 0.1, 'steep'", "cannot be loaded: AssertionError: steep"),
    ("class Tilted:\n    def __init__(self, tilt=0.5): raise SystemExit(0)", "cannot be loaded: SystemExit: 0"),
    ("class Tilted(dict):\n    pass", "no signature found"),
    ("class Tilted:\n    def __init__(self, tilt=0.5): raise ValueError('steep')", ": steep")])
def test_from_file_whose_class_cannot_be_made(tmp_path: Path, code: str, message: str) -> None:
    (tmp_path / "tilted.py").write_text(code)
    with pytest.raises(representations.RepresentationError, match=f"representation '.*tilted.py:Tilted'.*{message}"):
        representations.create(f"{tmp_path / 'tilted.py'}:Tilted")


def test_what_names_a_file_of_code() -> None:
    assert representations.file_of("a/b.py:Mine") == (Path("a/b.py"), "Mine")
    assert representations.file_of("C:\\a.py:Mine") == (Path("C:\\a.py"), "Mine")
    for name in ("jensen", "", "a.py", "a.py:/evil.so:Mine", "a.py:b:Mine", "a.pyc:Mine", "a.so:Mine"):
        assert representations.file_of(name) is None, name


def test_entry_point_that_cannot_be_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    entry = importlib.metadata.EntryPoint("tilted", "no_such_module:Tilted", representations.ENTRY_POINTS)
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group, name=None: [entry])
    with pytest.raises(representations.RepresentationError,
                       match="representation 'tilted', entry point no_such_module:Tilted, cannot be loaded: ModuleNotFound"):
        representations.create("tilted")


def test_from_entry_point(tmp_path: Path) -> None:
    """As an installed package would offer it: in its own process, with the package's metadata on the path."""
    (tmp_path / "tilted_lobe.py").write_text(OWN)
    info = tmp_path / "tilted_lobe-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: tilted-lobe\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{representations.ENTRY_POINTS}]\ntilted = tilted_lobe:Tilted\n")
    program = ("import representations, mitsuba as mi; mi.set_variant('llvm_ad_rgb'); "
               "assert 'tilted' in representations.names(); print(representations.create('tilted', tilt=2).tilt)")
    root = Path(representations.__file__).parents[1]
    run = subprocess.run([sys.executable, "-c", f"import sys; sys.path[:0] = [{str(tmp_path)!r}, {str(root)!r}]; {program}"],
                         capture_output=True, text=True, check=False)
    assert run.stdout.strip() == "2", run.stderr


def test_import_is_cheap() -> None:
    """`import representations` brings in neither Dr.Jit nor Mitsuba."""
    root = Path(representations.__file__).parents[1]
    program = (f"import sys; sys.path.insert(0, {str(root)!r}); import representations; "
               "print({'drjit', 'mitsuba', 'numpy'} & set(sys.modules))")
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert run.stdout.strip() == "set()", run.stdout + run.stderr
