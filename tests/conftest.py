"""Shared by all tests: a libLLVM that works, the variant, and a clean Dr.Jit between modules."""
from __future__ import annotations

import os

import representations  # noqa: F401  (selects libLLVM before drjit is imported)

# isort: split
import drjit as dr
import mitsuba as mi
import pytest


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--representation", help="check path/to/file.py:ClassName in test_conformance.py, instead of the registered")
    parser.addoption("--grid", action="store_true", help="in test_grid.py, every emitter alone, with four times the samples")


@pytest.fixture(autouse=True, scope="session")
def variant() -> str:
    """Every test runs in the variant that needs no GPU."""
    mi.set_variant("llvm_ad_rgb")
    return mi.variant()


@pytest.fixture(autouse=True, scope="session")
def cache_folder(tmp_path_factory: pytest.TempPathFactory) -> None:
    """No test knows which scene files others, or the user, have loaded."""
    os.environ["OLPM_BENCH_CACHE"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(autouse=True, scope="module")
def clean_drjit():
    """Free cached kernels' memory and pending work of the module before."""
    yield
    dr.sync_thread()
    dr.flush_malloc_cache()
