"""Which libLLVM is chosen, and what is said when none will do; each in a process of its own."""
from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import representations
from representations import _llvm

ROOT = Path(representations.__file__).parents[1]


def run(program: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A fresh Python with `representations` on its path; the variable is unset unless given."""
    inherited = {k: v for k, v in os.environ.items() if k != _llvm.VARIABLE}
    return subprocess.run([sys.executable, "-c", f"import sys; sys.path.insert(0, {str(ROOT)!r})\n{program}"], check=False,
                          capture_output=True, text=True, env=inherited | environment)


def last_line(process: subprocess.CompletedProcess[str]) -> str:
    return process.stderr.strip().splitlines()[-1]


WITHOUT_WHEEL = "import importlib.metadata as m\ndef none(name): raise m.PackageNotFoundError(name)\nm.files = none\n"
WITHOUT_SYSTEM = "from pathlib import Path\nPath.glob = lambda self, pattern: iter(())\n"
USE = "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); import drjit as dr; print(dr.max(mi.Float([1, 3, 2]))[0])"


@pytest.mark.parametrize(("name", "version"), [
    ("libLLVM.so.23.1", 23), ("libLLVM.so.19.1", 19), ("libLLVM-15.so.1", 15), ("libLLVM-14.so", 14), ("libLLVM-14.0.6.so.1", 14),
    ("libLLVM-9.so.1", 9), ("libLLVM-C.so.19.1", 19), ("libLLVM-21-rust-1.90-stable.so", 21)])
def test_version_in_the_file_name(tmp_path: Path, name: str, version: int) -> None:
    (tmp_path / name).touch()
    assert _llvm.version_of(tmp_path / name) == version


def test_version_behind_a_link(tmp_path: Path) -> None:
    (tmp_path / "libLLVM.so.18.1").touch()
    (tmp_path / "libLLVM.so").symlink_to("libLLVM.so.18.1")
    assert _llvm.version_of(tmp_path / "libLLVM.so") == 18


@pytest.mark.parametrize("name", ["libLLVM.dylib", "LLVM-C.dll", "libLLVM.so"])
def test_name_without_version(tmp_path: Path, name: str) -> None:
    """The library itself is asked; what can't be loaded has no version."""
    (tmp_path / name).touch()
    assert _llvm.version_of(tmp_path / name) is None


@pytest.mark.skipif(_llvm.wheel_library() is None, reason=f"{_llvm.WHEEL} is not installed")
def test_library_that_doesn_t_tell_its_version_by_name(tmp_path: Path) -> None:
    wheel = _llvm.wheel_library()
    folder = tmp_path / "lib"                       # so named in the library's search path for its C++ runtime
    folder.mkdir()
    shutil.copy(wheel, folder / "libLLVM.so")
    for runtime in (*wheel.parent.glob("*-linux-gnu"), *(wheel.parent / name for name in _llvm.RUNTIME)):
        if runtime.exists():
            (folder / runtime.name).symlink_to(runtime)
    process = run(f"import pathlib\nfrom representations import _llvm\n"
                  f"print(_llvm.version_of(pathlib.Path({str(folder)!r}, 'libLLVM.so')))")
    assert int(process.stdout) == _llvm.version_of(wheel), process.stderr


@pytest.mark.parametrize("version", [14, 15, 16])
def test_variable_names_a_version_that_crashes(tmp_path: Path, version: int) -> None:
    library = tmp_path / f"libLLVM-{version}.so.1"
    library.touch()
    process = run("import representations; print('too late')", DRJIT_LIBLLVM_PATH=str(library))
    assert process.returncode == 1 and not process.stdout
    assert last_line(process).endswith(f"{_llvm.VARIABLE}={library} is LLVM {version}, with which Dr.Jit aborts the "
                                       "process; unset it, or name a libLLVM >= 17")


def test_variable_names_something_else(tmp_path: Path) -> None:
    library = tmp_path / "compiler.so"
    library.touch()
    process = run("import representations", DRJIT_LIBLLVM_PATH=str(library))
    assert process.returncode == 1 and "can't be loaded as LLVM; unset it, or name a" in last_line(process)


def test_variable_names_no_file(tmp_path: Path) -> None:
    process = run("import representations", DRJIT_LIBLLVM_PATH=str(tmp_path / "libLLVM.so.19"))
    assert process.returncode == 1 and "libLLVM.so.19: there is no such file; unset it" in last_line(process)


def test_no_library_at_all() -> None:
    """Importing works, for those with a GPU; who needs LLVM gets one line that says what to install."""
    process = run(WITHOUT_WHEEL + WITHOUT_SYSTEM +
                  "import representations; print('imported')\nrepresentations._llvm.require()")
    assert process.stdout.strip() == "imported" and process.returncode == 1
    assert "LLVMError: no libLLVM >= 17 on this machine" in last_line(process)
    assert _llvm.INSTALL_LINE.get(sys.platform, _llvm.INSTALL_LINE["linux"]) in last_line(process)


def test_old_libraries_only(tmp_path: Path) -> None:
    """Dr.Jit would find them by itself and abort the process: it must fail with a Python exception instead."""
    library = tmp_path / "libLLVM-15.so.1"
    library.touch()
    before = WITHOUT_WHEEL + WITHOUT_SYSTEM + ("from representations import _llvm\n"
                                               f"_llvm.system_libraries = lambda: [(15, Path({str(library)!r}))]\n")
    process = run(before + f"_llvm.select()\n{USE}")
    assert process.returncode == 1 and "ImportError" in last_line(process)
    assert "LLVMError: no libLLVM >= 17" in last_line(run(before + "_llvm.require()"))
    assert "LLVMError: no libLLVM >= 17" in last_line(run(before + "_llvm.require()", DRJIT_LIBLLVM_PATH=_llvm.NONE))


@pytest.mark.skipif(_llvm.wheel_library() is None, reason=f"{_llvm.WHEEL} is not installed")
def test_the_wheel_is_found_and_works() -> None:
    process = run(f"import representations; print(representations._llvm.require())\n{USE}")
    library, result = process.stdout.split()
    assert Path(library) == _llvm.wheel_library() and float(result) == 3, process.stderr


def test_drjit_that_came_first_and_has_loaded_an_old_version() -> None:
    """What it says of its version is made up: there may be no such library here."""
    process = run("import drjit; drjit.detail.llvm_version = lambda: (15, 0, 6)\nimport representations")
    assert process.returncode == 1 and "LLVMError: Dr.Jit was imported first and has loaded LLVM 15" in last_line(process)
    harmless = "import drjit; drjit.detail.llvm_version = lambda: ({}, -1, -1)\nimport representations"
    for version in (-1, 19):
        assert run(harmless.format(version)).returncode == 0


def test_variable_that_works_is_kept() -> None:
    library = str(_llvm.require())
    program = "import representations; print(representations._llvm.require())"
    assert run(program, DRJIT_LIBLLVM_PATH=library).stdout.strip() == library


def test_newest_of_the_system(tmp_path: Path) -> None:
    for name in ("libLLVM-15.so.1", "libLLVM.so.18.1", "libLLVM.so.20.1", "libLLVM-C.so.19.1"):
        (tmp_path / name).touch()
    program = "import representations; print(representations._llvm.require())"
    found = run(WITHOUT_WHEEL + program, LD_LIBRARY_PATH=str(tmp_path)).stdout.strip()
    assert int(_llvm.version_of(Path(found)) or 0) >= 20
