"""Find a libLLVM that Dr.Jit can use, before Dr.Jit looks for one itself.

Dr.Jit accepts LLVM 15 and 16, then *aborts the process* when it compiles its first kernel
("Cannot select: fminimum").  It works from LLVM 17 on.  `DRJIT_LIBLLVM_PATH` decides which library it
loads, and it must be set before the first ``import drjit`` of a process: hence both our packages call
:func:`select` in their first line.  Nothing is loaded here, so importing stays cheap; on a machine that
only uses ``cuda_ad_rgb`` nothing is needed and nothing fails: Dr.Jit loads LLVM when an ``llvm_*``
variant is first used.
"""
from __future__ import annotations

import contextlib
import ctypes
import importlib.metadata
import os
import re
import sys
from pathlib import Path

OLDEST = 17          # first LLVM whose X86 back-end selects llvm.minimum.f32
WHEEL = "karellen-llvm-core"
RUNTIME = ("libunwind.so.1", "libc++abi.so.1", "libc++.so.1")       # of the wheel, in the order of loading
VARIABLE = "DRJIT_LIBLLVM_PATH"

NONE = "no-libLLVM-17-or-newer-found"        # set where Dr.Jit would find an older library by itself, and crash

INSTALL_LINE = {
    "linux": f"pip install '{WHEEL}>=19.1.7,<24'    (x86-64; elsewhere: sudo apt install libllvm19)",
    "darwin": f"brew install llvm && export {VARIABLE}=$(brew --prefix llvm)/lib/libLLVM.dylib",
    "win32": f"choco install llvm    then set {VARIABLE} to its LLVM-C.dll",
}


class LLVMError(ImportError):
    """No usable libLLVM; the message, one line, says what to do."""


def version_of(library: Path) -> int | None:
    """Major version of a libLLVM, from its file name, or else from the library itself; None if it is none.

    A library too old to know its version (the call came with LLVM 16) counts as 15.
    """
    match = re.search(r"LLVM(?:-C)?[.-]?(?:so\.)?(\d+)", library.resolve().name)
    if match:
        return int(match[1])
    try:
        preload_runtime(library)
        loaded = ctypes.CDLL(str(library))
    except OSError:
        return None
    if hasattr(loaded, "LLVMGetVersion"):
        major, minor, patch = ctypes.c_uint(), ctypes.c_uint(), ctypes.c_uint()
        loaded.LLVMGetVersion(ctypes.byref(major), ctypes.byref(minor), ctypes.byref(patch))
        return major.value
    return OLDEST - 2 if hasattr(loaded, "LLVMContextCreate") else None


def loaded_version() -> int | None:
    """Major version of the libLLVM that Dr.Jit has loaded; None if it was not imported yet, or has found none."""
    drjit = sys.modules.get("drjit")
    version = drjit.detail.llvm_version()[0] if drjit is not None else -1
    return version if version >= 0 else None


def wheel_library() -> Path | None:
    """The libLLVM that the wheel installed into this environment."""
    try:
        files = importlib.metadata.files(WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    found = [Path(str(f.locate())) for f in files if re.fullmatch(r"libLLVM(-\d+)?\.so[.\d]*", f.name)]
    return next((f.resolve() for f in found if f.exists()), None)


def system_libraries() -> list[tuple[int, Path]]:
    """(version, file) of every libLLVM in the system's library folders, oldest first."""
    fixed = ("/usr/lib", "/usr/lib64", "/usr/local/lib", "/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu",
             "/opt/homebrew/opt/llvm/lib", "/usr/local/opt/llvm/lib", "C:/Program Files/LLVM/bin")
    searched = os.environ.get("PATH" if sys.platform == "win32" else "LD_LIBRARY_PATH", "").split(os.pathsep)
    folders = [*(Path(f) for f in (*fixed, *searched) if f), Path(sys.prefix, "lib"),
               *Path("/usr/lib").glob("llvm-*/lib"), *Path("/usr/lib64").glob("llvm*/lib")]
    files = {f for folder in folders for pattern in ("libLLVM*.so*", "libLLVM*.dylib", "LLVM-C.dll")
             for f in folder.glob(pattern) if f.is_file()}
    return sorted((version, f) for f in files if (version := version_of(f)) is not None)


def preload_runtime(library: Path) -> None:
    """Load the C++ runtime where it lies beside a libLLVM whose search path misses it (``pip install --target``)."""
    for name in RUNTIME:
        runtime = library.parent / name
        if runtime.exists():
            with contextlib.suppress(OSError):      # not needed after all, or Dr.Jit will report that LLVM can't be loaded
                ctypes.CDLL(str(runtime), mode=ctypes.RTLD_GLOBAL)


def select() -> None:
    """Point Dr.Jit at a libLLVM that works; sets `DRJIT_LIBLLVM_PATH` for this process and its children.

    Order: the variable if the user has set it, the wheel, the system's newest.  Where the system has old ones only,
    the variable names no file, so that Dr.Jit reports a missing library instead of crashing.

    Raises:
        LLVMError: the variable names a missing file, no LLVM, or a version with which Dr.Jit crashes; or Dr.Jit was imported
            before and has found such a version by itself.
    """
    if (version := loaded_version()) is not None and version < OLDEST:
        raise LLVMError(f"Dr.Jit was imported first and has loaded LLVM {version}, with which it aborts the process; import "
                        f"olpm_bench before drjit and mitsuba, or name a libLLVM >= {OLDEST} in {VARIABLE}")
    if os.environ.get(VARIABLE, NONE) != NONE:
        library = Path(os.environ[VARIABLE])
        advice = f"unset it, or name a libLLVM >= {OLDEST}"
        if not library.is_file():
            raise LLVMError(f"{VARIABLE}={library}: there is no such file; {advice}")
        version = version_of(library)
        if version is None:
            raise LLVMError(f"{VARIABLE}={library} can't be loaded as LLVM; {advice}")
        if version < OLDEST:
            raise LLVMError(f"{VARIABLE}={library} is LLVM {version}, with which Dr.Jit aborts the process; {advice}")
        preload_runtime(library)
        return
    found = wheel_library()
    if found is None:
        system = system_libraries()
        if not system:
            return
        version, newest = system[-1]
        found = newest if version >= OLDEST else None
    if found is not None:
        preload_runtime(found)
    os.environ[VARIABLE] = str(found or NONE)


def require() -> Path:
    """The library in use, for those about to set an ``llvm_*`` variant.

    Raises:
        LLVMError: there is none; the message holds the line that installs one.
    """
    select()
    if os.environ.get(VARIABLE, NONE) == NONE:
        line = INSTALL_LINE.get(sys.platform, INSTALL_LINE["linux"])
        raise LLVMError(f"no libLLVM >= {OLDEST} on this machine (Dr.Jit crashes with older ones); install one: {line}")
    return Path(os.environ[VARIABLE])
