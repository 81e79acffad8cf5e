"""An experiment of two methods, whose images are tiny and whose budget is in samples; and cells that say something else."""
import json
from pathlib import Path
from typing import Any

from olpm_bench.bench import results

TOML = """
title = "Test"
seeds = 2
[budget]
spp = 11
checkpoints = 3
[[scene]]
name = "cornell_box"
width = 16
height = 12
max_depth = 4
[[method]]
name = "Path tracing"
[[method]]
name = "Roulette"
integrator = { roulette = "throughput" }
"""


def edit(cell: Path, **changes: Any) -> None:
    """Change a cell.json, and its digest."""
    info = json.loads(cell.read_text()) | changes
    del info["digests"]
    cell.write_text(json.dumps({**info, "digests": results._digests(info, cell.parent)}))
