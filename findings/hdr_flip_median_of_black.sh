#!/usr/bin/env bash
# HDR-FLIP jumps where more than half of a reference is exactly black: flip-evaluator 1.7.
#
# The longest exposure shows the median luminance of the reference bright.  Where more than half of the pixels are black, that
# median is 0, is replaced by a tiny number, and the evaluator goes up to 2^24 times the radiance, in 25 steps instead of 4 to 8.
# So a scene behind a door, or with a black background, has another error when one more column of pixels is black.  Fix the
# exposures (startExposure, stopExposure, numExposures) from the pixels that are not black.
#
# Output seen:
#   31 of 64 columns black: stop  4.68,  6 exposures
#   33 of 64 columns black: stop 24.08, 25 exposures
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check flip-evaluator==1.7 'numpy==2.3.5'
"$folder/venv/bin/python" - <<'PYTHON'
import flip_evaluator
import numpy as np

random = np.random.default_rng(1)
whole = random.gamma(1, 0.5, (48, 64, 3)).astype(np.float32)
noisy = np.maximum(whole + 0.1 * random.normal(size=whole.shape), 0).astype(np.float32)
stops = []
for black in (31, 33):
    reference, test = whole.copy(), noisy.copy()
    reference[:, :black] = test[:, :black] = 0
    _, _, parameters = flip_evaluator.evaluate(reference, test, "HDR", applyMagma=False)
    stops.append(parameters["stopExposure"])
    print(f"{black} of 64 columns black: stop {stops[-1]:5.2f}, {parameters['numExposures']:2d} exposures")
assert stops[1] - stops[0] > 15, "the exposures no longer jump"
PYTHON
