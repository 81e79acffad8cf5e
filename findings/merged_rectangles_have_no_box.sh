#!/usr/bin/env bash
# Mitsuba 3.9.1: mi.load_file and mi.load_string merge rectangles of one material into a mesh whose bounding box is invalid.
#
# The scene's own box leaves that mesh out.  Lights at infinity are placed by that box: shadow rays towards them end at its
# bounding sphere, before the walls that are outside of it.  Light then comes through these walls, without a message.  Here a
# closed room of six rectangles, with a sphere in it, lies under a constant sky: black is right.
#     optimize=True: all boxes valid: False, scene's box: [-0.2, -0.2, -0.2] to [0.2, 0.2, 0.2], mean 0.045
#     optimize=False: all boxes valid: True, scene's box: [-1, -1, -1] to [1, 1, 1], mean 0.000
# The remedy is optimize=False.
#
# Needs Python 3.11 or newer.  Exits with 1 if Mitsuba behaves otherwise.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mitsuba==3.9.1 numpy==2.2.6
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")
turns = [("x", 0), ("x", 90), ("x", 180), ("x", 270), ("y", 90), ("y", 270)]
walls = "".join(f'<shape type="rectangle"><transform name="to_world"><translate z="-1"/><rotate {axis}="1" angle="{angle}"/>'
                '</transform><ref id="grey"/></shape>' for axis, angle in turns)
scene = f"""<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,0.9" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/><rfilter type="box"/></film></sensor>
<bsdf type="twosided" id="grey"><bsdf type="diffuse"/></bsdf>{walls}
<shape type="sphere"><float name="radius" value="0.2"/></shape><emitter type="constant"/></scene>"""
means = []
for optimize in (True, False):
    loaded = mi.load_string(scene, optimize=optimize)
    valid = all(shape.bbox().valid() for shape in loaded.shapes())
    means.append(float(np.mean(np.array(mi.render(loaded, spp=16)))))
    print(f"optimize={optimize}: all boxes valid: {valid}, scene's box: {loaded.bbox().min} to {loaded.bbox().max}, mean {means[-1]:.3f}")
sys.exit(0 if means[0] > 0.01 and means[1] == 0 else 1)
PYTHON
