"""Scenes by other people: beside the checkout, or where OLPM_BENCH_SCENES says; none of them is part of this project."""
from __future__ import annotations

import os
from pathlib import Path

import pytest

FOLDER = Path(os.environ.get("OLPM_BENCH_SCENES") or Path(__file__).resolve().parents[3] / "shared" / "scenes")


def folder_of(name: str) -> Path:
    """The folder of a scene; the test is skipped where there is none."""
    if not (FOLDER / name / "scene.xml").exists():
        pytest.skip(f"needs {FOLDER / name}, or OLPM_BENCH_SCENES")
    return FOLDER / name
