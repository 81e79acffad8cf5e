#!/bin/sh
# Mitsuba 3.9.1: the density of a black environment map is NaN, not 0.
#
# `envmap.pdf_direction` divides by the mean of the map.  Where that is 0 it returns 0/0, while
# `sample_direction` says rightly that it has found nothing (pdf 0).  A MIS weight that is made of this
# density is NaN, and NaN times the map's radiance, 0, is NaN: whoever adds up a path without a special case
# gets NaN pixels wherever a path leaves the scene.
#
# Seen with mitsuba 3.9.1, scalar_rgb:
#     density of a hit: nan   radiance: 0.0   density of a sample: 0.0
#
# Ends with 0 as long as it is so, with 1 when it has changed.
set -e
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mitsuba==3.9.1 drjit==1.5.0 numpy
"$folder/venv/bin/python" - <<'PYTHON'
import math
import sys

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")
sky = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(np.zeros((4, 8, 3), np.float32))})
scene = mi.load_dict({"type": "scene", "sky": sky, "ball": {"type": "sphere"}})
nowhere = mi.Interaction3f()
miss = scene.ray_intersect(mi.Ray3f([0, 0, 5], [0, 0.6, 0.8]))
pdf = scene.pdf_emitter_direction(nowhere, mi.DirectionSample3f(scene, miss, nowhere))
radiance = max(miss.emitter(scene).eval(miss))
sample, _ = scene.sample_emitter_direction(nowhere, [0.3, 0.6], False)
print(f"density of a hit: {pdf}   radiance: {radiance}   density of a sample: {sample.pdf}")
sys.exit(0 if math.isnan(pdf) and radiance == 0 and sample.pdf == 0 else 1)
PYTHON
