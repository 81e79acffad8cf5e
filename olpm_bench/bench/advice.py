"""What a row of the summary suggests to do, in sentences that stand below the table.

Each says what was found and, after it, what to do: a newcomer can act on it without the documentation.
"""
from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from olpm_bench.bench.reference_file import NEAR_FLOOR

LATE = 0.05                 # share of a budget in seconds by which a cell may exceed it, before that is said
SLOWER = 0.95               # `worst_speed_up` below which that is said
TRAINED = 0.4               # share of a budget in seconds that training may take, before that is said


def sentences(row: Mapping[str, Any]) -> list[str]:
    """The sentences on a method in a scene; none where all is as it should be.

    Args:
        row: of the summary, see `summary.summarise`.
    """
    said = []
    in_seconds, learnt = row["overrun"] is not None, row["training_passes"] > 0
    share = row["train_seconds"] / row["charged_seconds"] if row["charged_seconds"] else 0.0
    if in_seconds and share >= TRAINED:
        said.append(f"{percent(share)} of this budget went into training; a longer one favours guiding")
    if learnt and row["gain_high"] is not None and row["gain_high"] < 1:
        said.append("guiding costs more here than it saves; it needs light that is harder to find, or a longer budget")
    if in_seconds and row["overrun"] > LATE:
        said.append(f"took {percent(row['overrun'])} more time than its budget, as its passes take long; a longer budget, or "
                    "fewer photons or camera paths a pass, keeps the comparison at equal time")
    if row["noise_floor"] and row["l1"] < NEAR_FLOOR * row["noise_floor"]:
        said.append(f"its L1 error is only {row['l1'] / row['noise_floor']:.2g} times the reference's noise, a part of it; go on "
                    "with the reference by olpm-bench reference, or trust the gain, which needs none")
    if row["worst_speed_up"] is not None and row["worst_speed_up"] < SLOWER:
        said.append(f"{row['worst_speed_up']:.2g}x as fast as the baseline to the L1 error where it compares worst; see in the "
                    "figure from which time on it is ahead, and compare at your own budget")
    return said


def percent(share: float) -> str:
    """0.45 as "45 %"."""
    return f"{100 * share:.0f} %"
