#!/usr/bin/env bash
# Mitsuba 3.9.1: `ptracer` and `path` disagree over `normalmap` and `bumpmap`.
#
# A diffuse floor whose shading normals all lean by 30 degrees is lit by a directional light from 45 degrees, and seen from
# above.  One would expect the same image from both integrators.  Where the normals lean towards the light, `ptracer` has
# cos 30 cos 45 / cos 15 = 0.634 times the radiance of `path`, and where they lean away  cos 30 cos 45 / cos 75 = 2.37  times.
# Without a map the two agree.
# `ptracer` corrects for shading normals by the frame in the surface interaction; that of the map lives inside the BSDF.
#
# Output seen (the noise is 1 %):
#   normalmap, towards: ptracer / path = 0.645
#   normalmap, away: ptracer / path = 2.407
#   bumpmap, towards: ptracer / path = 0.645
#   bumpmap, away: ptracer / path = 2.407
#   no map: ptracer / path = 1.007
#
# Exits with 1 if that has changed.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mitsuba==3.9.1 drjit==1.5.0 "numpy>=2"

"$folder/venv/bin/python" - <<'PYTHON'
import sys

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")
T = mi.ScalarTransform4f
LEAN, LIGHT = np.radians(30), np.radians(45)
DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.7}}


def bitmap(image):
    return {"type": "bitmap", "bitmap": mi.Bitmap(image.astype(np.float32)), "raw": True, "wrap_mode": "clamp"}


def normal_map(lean):
    normal = (np.array([np.sin(lean), 0, np.cos(lean)]) + 1) / 2
    return {"type": "normalmap", "normalmap": bitmap(np.tile(normal, (2, 2, 1))), "bsdf": DIFFUSE}


def bump_map(lean):
    """A height that falls along x by the tangent of the lean; the floor is 2 units wide."""
    centres = (np.arange(64) + 0.5) / 64
    height = np.broadcast_to(centres[None, :, None], (64, 64, 1))
    return {"type": "bumpmap", "scale": -2 * np.tan(lean), "bump": bitmap(height), "bsdf": DIFFUSE}


def ratio(bsdf):
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    scene = mi.load_dict({
        "type": "scene",
        "floor": {"type": "rectangle", "bsdf": bsdf},
        "light": {"type": "directional", "direction": [-np.sin(LIGHT), 0, -np.cos(LIGHT)]},
        "sensor": {"type": "perspective", "fov": 15, "film": film, "to_world": T().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])}})
    images = [np.array(mi.render(scene, integrator=mi.load_dict({"type": kind, "max_depth": 2}), spp=spp))
              for kind, spp in (("ptracer", 20_000), ("path", 16))]
    return images[0].mean() / images[1].mean()


expected = {"normalmap, towards": (normal_map(LEAN), 0.634), "normalmap, away": (normal_map(-LEAN), 2.366),
            "bumpmap, towards": (bump_map(LEAN), 0.634), "bumpmap, away": (bump_map(-LEAN), 2.366), "no map": (DIFFUSE, 1.0)}
changed = False
for name, (bsdf, value) in expected.items():
    found = ratio(bsdf)
    print(f"{name}: ptracer / path = {found:.3f}", flush=True)
    changed |= not abs(found / value - 1) < 0.05
sys.exit(changed)
PYTHON
