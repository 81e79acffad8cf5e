"""The mixture of BSDF and guide has the expectation of the BSDF alone, also where the guide's samples fail."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from olpm_bench.transport.guide import GuidedPoint
from olpm_bench.transport.guided_bsdf import GuidedBSDF

N = 400_000

BSDFS = {
    "diffuse": {"type": "diffuse"},
    "rough conductor": {"type": "roughconductor", "alpha": 0.3},
    "rough dielectric": {"type": "roughdielectric", "alpha": 0.3},
    "plastic": {"type": "plastic"},
    "rough plastic": {"type": "roughplastic"},
    "principled": {"type": "principled", "roughness": 0.4, "spec_trans": 0.4, "eta": 1.4},
    "mask": {"type": "mask", "opacity": 0.6, "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse"}}},
    "blend": {"type": "blendbsdf", "weight": 0.4, "a": {"type": "conductor"}, "b": {"type": "diffuse"}},
    "mirror": {"type": "conductor"},
}


class UniformHemisphere:
    """A representation whose samples fail with some probability."""

    def __init__(self, failure: float) -> None:
        self.failure = failure

    def sample(self, state, record, sample1, sample2, active=True, at=None):
        failed = sample1 < self.failure
        wo = dr.select(failed, mi.Vector3f(0, 0, -1), mi.warp.square_to_uniform_hemisphere(sample2))
        return wo, self.pdf(state, record, wo)

    def pdf(self, state, record, wo, active=True, at=None):
        return dr.select(wo.z > 0, (1 - self.failure) * dr.inv_two_pi, 0)


class OneRecord:
    """A guide that has the same distribution everywhere."""
    records, state = 1, None

    def __init__(self, failure: float) -> None:
        self.representation = UniformHemisphere(failure)
        self.rows = mi.Float(1, 0, -1, 0)       # has seen enough; nothing learnt of the fraction and of what it returns

    def at(self, p, n, active):
        return GuidedPoint(self, mi.UInt32(0), mi.Frame3f(n), mi.Bool(active))


def _interaction(theta: float) -> mi.SurfaceInteraction3f:
    si = dr.zeros(mi.SurfaceInteraction3f, N)
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    si.wi = mi.Vector3f(float(np.sin(theta)), 0, float(np.cos(theta)))
    return si


def _moments(bsdf: mi.BSDF, guide: OneRecord | None, seed: int) -> np.ndarray:
    """Samples of the weight times 1, wo.x and wo.z [3, N]: their means are integrals of the BSDF."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, N)
    guided = GuidedBSDF(mi.BSDFPtr(bsdf), _interaction(0.6), guide, 0.5, mi.Bool(True))
    bs, weight = guided.sample(mi.BSDFContext(), sampler.next_1d(), sampler.next_2d(), mi.Bool(True))
    weight, wo = weight.numpy()[0], bs.wo.numpy()
    return np.stack([weight, weight * wo[0], weight * wo[2]])


@pytest.mark.parametrize("failure", [0.0, 0.5])
@pytest.mark.parametrize("name", BSDFS)
def test_moments_of_the_bsdf(name, failure):
    bsdf = mi.load_dict(BSDFS[name])
    expected, guided = _moments(bsdf, None, 1), _moments(bsdf, OneRecord(failure), 2)
    error = np.sqrt((expected.var(1) + guided.var(1)) / N)
    assert np.all(np.abs(expected.mean(1) - guided.mean(1)) < 4.5 * error + 1e-5)      # 54 tests, 7e-6 each


@pytest.mark.parametrize("name", BSDFS)
def test_density_and_value_are_those_of_the_sample(name):
    """eval_pdf of the sampled direction gives back the density of the sample, and value / density its weight."""
    bsdf = mi.load_dict(BSDFS[name])
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, N)
    guided = GuidedBSDF(mi.BSDFPtr(bsdf), _interaction(0.6), OneRecord(0.1), 0.5, mi.Bool(True))
    ctx, zeros = mi.BSDFContext(), mi.Point2f(0.5)
    bs, weight = guided.sample(ctx, sampler.next_1d(), sampler.next_2d(), mi.Bool(True))
    value, pdf, _, _ = guided.eval_pdf_sample(ctx, bs.wo, mi.Float(0.5), zeros, mi.Bool(True))
    smooth = (dr.max(weight) > 0) & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    smooth = smooth.numpy() & np.ones(N, bool)
    if name == "mirror":
        assert not smooth.any()
        return
    np.testing.assert_allclose((pdf + dr.zeros(mi.Float, N)).numpy()[smooth], bs.pdf.numpy()[smooth], rtol=5e-3)
    np.testing.assert_allclose((value / pdf).numpy()[0][smooth], weight.numpy()[0][smooth], rtol=1e-2, atol=1e-5)
