"""Files: JSON, and writes that are whole or leave what was there."""
from __future__ import annotations

import numpy as np
import pytest

from olpm_bench.bench.files import read_json, replacing, write_json, write_text


def test_json_has_no_nan(tmp_path):
    write_json(tmp_path / "x.json", {"schema_version": 1, "a": float("nan"), "b": [np.float32("inf"), np.int64(3)]})
    assert read_json(tmp_path / "x.json") == {"schema_version": 1, "a": None, "b": [None, 3]}


def test_a_failed_write_leaves_what_was_there(tmp_path):
    write_text(tmp_path / "x", "old")
    with pytest.raises(KeyError), replacing(tmp_path / "x") as beside:
        beside.write_text("half of the ne")
        raise KeyError
    assert (tmp_path / "x").read_text() == "old" and [f.name for f in tmp_path.iterdir()] == ["x"]
