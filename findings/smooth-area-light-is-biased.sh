#!/bin/sh
# Mitsuba 3.9.1: an area light on a mesh with smooth vertex normals gets a wrong image from `path`, `direct`
# and all that samples lights.
#
# `Mesh::sample_position` returns the interpolated normal, and `Shape::sample_direction` turns the density
# per area into one per solid angle by that normal: p_A r^2 / |cos n_s| in place of p_A r^2 / |cos n_g|.
# The weight L / pdf of the light sample is then wrong by cos n_s / cos n_g, whatever MIS does.  With a
# texture as radiance it is right there and wrong in `pdf_direction` of a hit.  The same point estimates the
# irradiance below a square lamp whose normals point outwards.
#
# Seen with mitsuba 3.9.1, scalar_rgb:
#     by light samples: 0.2119   by uniform directions: 0.4185 +- 0.0024
#
# Ends with 0 as long as both differ by more than 10 %, with 1 when that has changed.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mitsuba==3.9.1 drjit==1.5.0 numpy
cd "$folder"
cat > lamp.obj <<'OBJ'
v -1 -1 1
v -1 1 1
v 1 1 1
v 1 -1 1
vn -0.63245553 -0.63245553 -0.4472136
vn -0.63245553 0.63245553 -0.4472136
vn 0.63245553 0.63245553 -0.4472136
vn 0.63245553 -0.63245553 -0.4472136
f 1//1 2//2 3//3
f 1//1 3//3 4//4
OBJ
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")
scene = mi.load_dict({"type": "scene", "lamp": {
    "type": "obj", "filename": "lamp.obj", "emitter": {"type": "area", "radiance": 1.0}}})
point = mi.Interaction3f()
point.p = [0.3, 0.0, 0.0]
rng, n = np.random.default_rng(0), 100_000
by_samples, by_directions = np.zeros(n), np.zeros(n)
for i, (u, v) in enumerate(rng.random((n, 2))):
    ds, weight = scene.sample_emitter_direction(point, [u, v], True)
    by_samples[i] = weight[0] * max(ds.d.z, 0) / np.pi
    d = mi.warp.square_to_uniform_hemisphere([u, v])
    si = scene.ray_intersect(mi.Ray3f(point.p, d))
    if si.is_valid():
        by_directions[i] = si.emitter(scene).eval(si)[0] * d.z / np.pi * 2 * np.pi
error = by_directions.std() / n ** 0.5
biased, right = by_samples.mean(), by_directions.mean()
print(f"by light samples: {biased:.4f}   by uniform directions: {right:.4f} +- {error:.4f}")
sys.exit(0 if abs(biased / right - 1) > 0.1 else 1)
PYTHON
