"""What an installation holds: its packages, experiments and references, which are found without a clone."""
from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import olpm_bench
from olpm_bench import shipped

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
SETUPTOOLS = PROJECT["tool"]["setuptools"]
LARGEST = 8e6               # bytes of experiments and references


def source(package: str) -> Path:
    return ROOT / SETUPTOOLS["package-dir"].get(package, package.replace(".", "/"))


def data(package: str) -> list[Path]:
    return [file for pattern in SETUPTOOLS["package-data"].get(package, []) for file in source(package).glob(pattern)]


def test_every_package_is_installed():
    found = {".".join(init.parent.relative_to(ROOT).parts) for top in ("olpm_bench", "representations")
             for init in (ROOT / top).rglob("__init__.py")}
    assert set(SETUPTOOLS["packages"]) == found | set(SETUPTOOLS["package-dir"])


def test_what_is_no_code_is_installed_and_is_not_large():
    code = {".py", ".pyc"}
    for package in ("olpm_bench", "representations"):
        others = {f for f in source(package).rglob("*") if f.is_file() and f.suffix not in code}
        assert others == set(data(package))
    files = [*data("olpm_bench.experiments"), *data("olpm_bench.references")]
    assert {f.parent for f in files if f.suffix == ".exr"} == {f.parent for f in files if f.name == "meta.json"}
    assert len([f for f in files if f.suffix == ".toml"]) == len(list((ROOT / "experiments").iterdir()))
    assert sum(f.stat().st_size for f in files) < LARGEST


def test_the_version_has_one_source():
    assert PROJECT["project"]["dynamic"] == ["version"] and "version" not in PROJECT["project"]
    assert SETUPTOOLS["dynamic"]["version"] == {"attr": "olpm_bench.__version__"}
    tree = ast.parse((ROOT / "olpm_bench" / "__init__.py").read_text(encoding="utf-8"))        # so setuptools reads it
    values = [ast.literal_eval(node.value) for node in tree.body if isinstance(node, ast.Assign)
              and ast.unparse(node.targets[0]) == "__version__"]
    assert values == [olpm_bench.__version__]
    assert re.search(rf"^version: {re.escape(olpm_bench.__version__)}$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)


@pytest.fixture(scope="module")
def installation(tmp_path_factory) -> Path:
    """A folder of packages as `pip install .` leaves it, far from the clone."""
    site = tmp_path_factory.mktemp("site")
    for package in SETUPTOOLS["packages"]:
        folder = site / package.replace(".", "/")
        folder.mkdir(parents=True, exist_ok=True)
        files = [*source(package).glob("*.py"), *data(package)]
        for file in files:
            target = folder / file.relative_to(source(package))
            target.parent.mkdir(exist_ok=True)
            shutil.copy(file, target)
    return site


@pytest.mark.parametrize("name", ["quickstart", "experiments/quickstart.toml"])
def test_an_installation_finds_experiments_and_references_in_an_empty_folder(installation, tmp_path, name):
    env = {**os.environ, "PYTHONPATH": str(installation)}
    command = [sys.executable, "-m", "olpm_bench.cli", "run", name, "--dry-run"]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr           # else, for want of a reference, it would be refused
    assert "door_ajar / GMM / seed 2" in done.stdout and "12 of 12 cells to run" in done.stdout
    assert "takes about" not in done.stdout and not list(tmp_path.iterdir())


def test_names_of_experiments(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quickstart = shipped.folder("experiments") / "quickstart.toml"
    for name in ("quickstart", "quickstart.toml", "experiments/quickstart.toml"):
        assert shipped.experiment_file(Path(name)) == quickstart
    for name in ("quikstart", "other/quickstart.toml", "quickstart.xml", "../quickstart"):
        assert shipped.experiment_file(Path(name)) == Path(name)
    assert shipped.named(quickstart) == "quickstart" and shipped.named(Path("experiments/a.toml")) == "experiments/a.toml"
    own = Path("experiments/quickstart.toml")
    own.parent.mkdir()
    own.touch()
    assert shipped.experiment_file(Path("quickstart")) == own           # one's own come first, and a file before all
    Path("quickstart").touch()
    assert shipped.experiment_file(Path("quickstart")) == Path("quickstart")
