"""The references that come with the project: of the scenes as they are now, and a measure of how hard these are."""
from __future__ import annotations

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from scipy import stats

from olpm_bench import scenes
from olpm_bench.bench.reference_file import read_reference
from olpm_bench.check.small_scenes import blocks, passes
from olpm_bench.check.verdict import sidak
from olpm_bench.scenes.load import load

FOLDER = Path(__file__).resolve().parents[2] / "results" / "references"
FOUND = {path.parent.name: json.loads(path.read_text()) for path in sorted(FOLDER.glob("*/meta.json"))}
EMBEDDED = {key: meta for key, meta in FOUND.items() if meta["scene"] in scenes.names()}
# The classroom's sky is an easy light beside its sun, for guided emission: 19,000 samples.
HARD = {key: meta for key, meta in EMBEDDED.items() if meta["scene"] != "cornell_box" and not meta["parameters"].get("sky")}
SIZE = 18                   # of blocks, in pixels along each side: so large that t-tests bear their skewness


def scene_of(meta: dict) -> mi.Scene:
    return load(meta["scene"], meta["parameters"], meta["width"], meta["height"], max_depth=meta["max_depth"])


@pytest.mark.parametrize("key", HARD)
def test_most_pixels_are_black_at_one_sample_and_light_comes_in(key):
    image = np.array(mi.render(scene_of(HARD[key]), spp=1, seed=5))
    black = np.mean(image.max(axis=2) == 0)
    print(f"{key}: {black:.1%} of the pixels are black at one sample")
    assert 0.9 < black < 1


@pytest.mark.parametrize("key", HARD)
def test_plain_path_tracing_needs_20k_samples(key):
    """To a relative standard deviation of 5 % of the median pixel's green, by the variance of the reference's own halves."""
    meta = HARD[key]
    reference = read_reference(FOLDER / key, meta["width"], meta["height"])
    variance = 0.5 * (meta["spp_a"] * reference.a_variance + meta["spp_b"] * reference.b_variance)
    needed = np.median((variance / np.maximum(reference.mean, 1e-9) ** 2 / 0.05 ** 2)[..., 1])
    print(f"{key}: {needed:,.0f} samples for 5 %")
    assert needed > 20_000


@pytest.mark.slow
@pytest.mark.parametrize("key", EMBEDDED)
def test_references_are_of_the_scenes_as_they_are(key):
    """Means of blocks of pixels; what of the image is too narrow for one more is left out."""
    meta = EMBEDDED[key]
    reference = read_reference(FOLDER / key, meta["width"], meta["height"])
    images = passes(scene_of(meta), mi.load_dict({"type": "path", "max_depth": meta["max_depth"]}), 16, 64, seed=77)
    height, width = (size // SIZE * SIZE for size in images.shape[1:3])
    now, then = (blocks(x[:, :height, :width], SIZE) for x in (images, reference.mean[None]))
    p = stats.ttest_1samp(now, then[0]).pvalue
    assert p.min() > sidak(1e-3, len(p)), now.mean(0) / then[0]
