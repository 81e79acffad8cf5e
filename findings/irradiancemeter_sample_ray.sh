#!/usr/bin/env bash
# Mitsuba 3.9.1: `irradiancemeter` implements Sensor.sample_ray_differential, but not Sensor.sample_ray.
#
# All other sensors have both, and the documentation of Sensor.sample_ray says that the two differ in the ray differentials
# alone.  An integrator in Python that calls sample_ray works with every sensor but this one, where it ends with
#     RuntimeError: [Endpoint] Endpoint::sample_ray(): not implemented!
# The remedy is to call sample_ray_differential.
#
# Needs Python 3.11 or newer.  Exits with 1 if Mitsuba behaves otherwise.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet mitsuba==3.9.1
"$folder/venv/bin/python" - <<'PYTHON'
import sys

import mitsuba as mi

mi.set_variant("scalar_rgb")
film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
scene = mi.load_dict({"type": "scene", "meter": {"type": "rectangle", "sensor": {"type": "irradiancemeter", "film": film}},
                      "sky": {"type": "constant"}})
meter = scene.sensors()[0]
ray, weight = meter.sample_ray_differential(0, 0.5, [0.5, 0.5], [0.5, 0.5])
print("sample_ray_differential: origin", ray.o, "weight", weight)
try:
    print("sample_ray: weight", meter.sample_ray(0, 0.5, [0.5, 0.5], [0.5, 0.5])[1])
except RuntimeError as error:
    print("sample_ray:", error)
    sys.exit(0 if "not implemented" in str(error) else 1)
sys.exit("sample_ray works now")
PYTHON
