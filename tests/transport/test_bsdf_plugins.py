"""Mitsuba's own BSDFs: sample() realises pdf(), and returns eval() / pdf().  On this the guided mixture stands, and `path`."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_grid import BSDFS
from scipy import stats

from olpm_bench.check.samples import chi_square
from olpm_bench.check.verdict import sidak

N = 400_000
BINS = 16                   # along both cos(theta) and phi
FEWEST = 50.0               # samples of a bin; bins with fewer are pooled
ANGLES = (0.3, 1.2, np.pi - 0.8)        # of incidence, the last from below
LEVEL = sidak(0.01, len(BSDFS) * len(ANGLES))

# Those of Mitsuba 3.9.1 whose densities are not realised where the BSDF has no value: below the horizon or on the dark side pdf()
# is not 0, or samples of weight 0 report a density.  No image depends on it.
STRAY = {"diffuse", "roughconductor", "roughconductor, all normals", "roughdielectric", "roughdielectric, ggx", "roughplastic",
         "principled, transmissive", "principledthin", "blendbsdf", "blendbsdf, textured", "twosided", "bumpmap", "measured"}

pytestmark = pytest.mark.slow


def _interaction(theta: float) -> mi.SurfaceInteraction3f:
    """A point of a square, with all that bump and normal maps ask for, seen at an angle."""
    square = mi.load_dict({"type": "scene", "square": {"type": "rectangle"}})
    direction = mi.Vector3f(float(np.sin(theta)), 0.0, float(np.cos(theta)))
    origin = mi.Point3f(0.23, 0.41, 0) + direction + dr.opaque(mi.Float, 0, N)
    return square.ray_intersect(mi.Ray3f(origin, -direction))


class Directions:
    """Densities [1/sr] and values in red of N directions; `used` are those that count."""

    def __init__(self, wo: mi.Vector3f, pdf: mi.Float, value: mi.Color3f, used: mi.Bool) -> None:
        self.wo, self.pdf, self.value, self.used = wo.numpy().T, _wide(pdf), _wide(value.x), _wide(used) > 0
        self.valued = self.used & (_wide(dr.max(value)) > 0)


def _wide(x: mi.Float | mi.Bool) -> np.ndarray:
    return np.broadcast_to(x.numpy().astype(float), N)


def draw(bsdf: mi.BSDF, theta: float, seed: int = 1) -> tuple[Directions, Directions, Directions]:
    """The BSDF's samples but for specular ones, as sample() says and as eval() and pdf() say; and uniform directions.

    Samples of weight 0 have failed, whatever eval() says of their directions.
    """
    ctx, si = mi.BSDFContext(), _interaction(theta)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, N)
    bs, weight = bsdf.sample(ctx, si, sampler.next_1d(), sampler.next_2d())
    smooth = (bs.pdf > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    value, pdf = bsdf.eval_pdf(ctx, si, bs.wo)
    uniform = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    uniform_value, uniform_pdf = bsdf.eval_pdf(ctx, si, uniform)
    dr.eval(bs, weight, smooth, value, pdf, uniform, uniform_value, uniform_pdf)
    return (Directions(bs.wo, bs.pdf, weight * bs.pdf, smooth), Directions(bs.wo, pdf, value, smooth),
            Directions(uniform, uniform_pdf, uniform_value, uniform_pdf > 0))


def follow_pdf(samples: Directions, uniform: Directions, factor: float = 1, valued: bool = True) -> float:
    """p-value of chi-square: `olpm_bench.check.samples.follow_pdf` explains the terms.

    Args:
        factor: by which pdf() is taken to be larger.
        valued: leave out where the BSDF has no value.
    """
    q, f, g = 1 / (4 * np.pi), factor * samples.pdf, factor * uniform.pdf
    sampled, expected = _means(q / (q + f), samples, valued), _means(g / (q + g), uniform, valued)
    chi2, bins, _ = chi_square(sampled, expected, (sampled + expected) / (2 * N), FEWEST / N)
    return float(stats.chi2.sf(chi2, bins))


def _means(terms: np.ndarray, d: Directions, valued: bool) -> np.ndarray:
    z, phi = (d.wo[:, 2] + 1) / 2, np.arctan2(d.wo[:, 1], d.wo[:, 0]) / (2 * np.pi) + 0.5
    row, column = (np.clip(x * BINS, 0, BINS - 1).astype(int) for x in (z, phi))
    terms = np.where(d.valued if valued else d.used, terms, 0)
    return np.bincount(row * BINS + column, terms, BINS**2) / N


@pytest.mark.parametrize("name", BSDFS)
def test_samples_realise_the_density(name):
    bsdf, stray = mi.load_dict(BSDFS[name]()), False
    for theta in ANGLES:
        reported, samples, uniform = draw(bsdf, theta)
        here = reported.valued
        np.testing.assert_allclose(reported.pdf[here], samples.pdf[here], rtol=1e-2)
        np.testing.assert_allclose(reported.value[here], samples.value[here], rtol=1e-2, atol=1e-5)
        if here.any():
            assert follow_pdf(reported, uniform) > LEVEL, theta
        else:                           # specular, or the dark side
            assert not uniform.valued.any()
        stray |= reported.used.any() and follow_pdf(reported, uniform, valued=False) < LEVEL
    assert stray == (name in STRAY)


def test_a_wrong_density_is_seen():
    reported, _, uniform = draw(mi.load_dict(BSDFS["roughplastic"]()), ANGLES[0])
    assert follow_pdf(reported, uniform) > LEVEL > follow_pdf(reported, uniform, factor=1.05)
