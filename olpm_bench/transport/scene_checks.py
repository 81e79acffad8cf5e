"""What is looked at once in a scene: whether it can be guided in, and whether a guide is of this scene."""
from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from olpm_bench.transport.settings import InputError

MOVED = 1e-3            # of the diagonal: corners of a scene's box that are farther apart are those of another scene


def require_valid_box(scene: mi.Scene) -> None:
    """Refuse a scene whose box leaves out surfaces, where lights at infinity shine through walls outside of it.

    Mitsuba 3.9.1 gives meshes that `mi.load_file` has merged from rectangles an invalid box.

    Raises:
        InputError: it is such a scene.
    """
    if not any(mi.has_flag(e.flags(), mi.EmitterFlags.Infinite) for e in scene.emitters()):
        return
    without = sum(not shape.bbox().valid() for shape in scene.shapes())
    if without:
        raise InputError(f"{without} of the scene's {len(scene.shapes())} shapes have no valid bounding box, so that light from "
                         "infinity passes through them: load it by olpm_bench.load_scene(path), or "
                         "mi.load_file(path, optimize=False)")


@dataclass(frozen=True)
class Fingerprint:
    """What tells scenes apart that have little to do with each other.

    shapes, emitters: how many.
    box: corners of the scene's bounding box [6]; None: it is not valid.
    """
    shapes: int
    emitters: int
    box: tuple[float, ...] | None

    @staticmethod
    def of(scene: mi.Scene) -> Fingerprint:
        box = scene.bbox()
        corners = tuple(float(x) for corner in (box.min, box.max) for x in corner) if box.valid() else None
        return Fingerprint(len(scene.shapes()), len(scene.emitters()), corners)

    @staticmethod
    def from_json(said: Any) -> Fingerprint | None:
        """
        Raises:
            ValueError, TypeError, LookupError: it is no fingerprint, nor None.
        """
        if said is None:
            return None
        box = None if said["box"] is None else tuple(float(x) for x in said["box"])
        if box is not None and len(box) != 6:
            raise ValueError("scene")
        return Fingerprint(int(said["shapes"]), int(said["emitters"]), box)

    def difference(self, other: Fingerprint) -> str | None:
        """In words, what distinguishes the scene of this fingerprint from another; None: nothing."""
        for kind in ("shapes", "emitters"):
            mine, theirs = getattr(self, kind), getattr(other, kind)
            if mine != theirs:
                return f"{mine} {kind}, and not {theirs}"
        if self.box is None or other.box is None:
            return None if self.box == other.box else "another bounding box"
        mine, theirs = np.array(self.box), np.array(other.box)
        diagonal = float(np.linalg.norm(mine[3:] - mine[:3]))
        if np.abs(mine - theirs).max() <= MOVED * diagonal:
            return None
        return f"the bounding box {_corners(self.box)}, and not {_corners(other.box)}"


def _corners(box: tuple[float, ...]) -> str:
    low, high = (", ".join(f"{x:.4g}" for x in corner) for corner in (box[:3], box[3:]))
    return f"({low}) to ({high})"
