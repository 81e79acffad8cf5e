#!/bin/sh
# Mitsuba 3.9.1: rays start 9e-5 (1 + max |p|) off surfaces, so that images of a small scene far from the
# origin are wrong.
#
# The distance grows with the coordinates, not with the scene: a room of two units that is 5,400 units away
# is traced as if rays started half a unit above its surfaces.  Floating point asks for far less: 16 units
# in the last place of a coordinate (5e-3 there) leave no ray that meets its own surface, on any shape
# tried.  One would guess that an image does not depend on where the origin is.  A scene of 1e-4 units
# beside the origin is wrong in the same way: its rays start 9e-5 off.
#
# Seen with mitsuba 3.9.1, scalar_rgb (a floor, a ball on it, and a lamp close above):
#     mean of the image at the origin: 0.0494   5,400 units away: 0.0468
#
# Ends with 0 as long as both differ by more than 3 %, with 1 when that has changed.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mitsuba==3.9.1 drjit==1.5.0 numpy
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")
T = mi.ScalarTransform4f


def mean(at: float) -> float:
    move = T().translate([at, 0.3 * at, -1.08 * at])
    floor = {"type": "rectangle", "to_world": move @ T().scale(2)}
    ball = {"type": "sphere", "to_world": move @ T().translate([0, 0, 0.5]) @ T().scale(0.5)}
    down = T().look_at([0.8, 0, 0.7], [0.8, 0, 0], [0, 1, 0]) @ T().scale(0.4)
    lamp = {"type": "rectangle", "to_world": move @ down, "emitter": {"type": "area", "radiance": 4.0}}
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    view = T().look_at([0, -4, 2], [0, 0, 0.4], [0, 0, 1])
    camera = {"type": "perspective", "film": film, "to_world": move @ view}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "path", "max_depth": 4}, "floor": floor,
                          "ball": ball, "lamp": lamp, "camera": camera}, optimize=False)
    return float(np.array(mi.render(scene, spp=256)).mean())


near, far = mean(0.0), mean(5000.0)
print(f"mean of the image at the origin: {near:.4f}   5,400 units away: {far:.4f}")
sys.exit(0 if abs(far / near - 1) > 0.03 else 1)
PYTHON
