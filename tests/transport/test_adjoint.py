"""Photons carry the flux that Mitsuba's `path` sees, whatever scatters them.

Through a point of a surface go light paths that begin along a and end along o, and camera paths that begin along o and end
along a.  Both estimate the same integral of  f(o, a) cos_s(a) |n . o|  over pairs of directions, so both are drawn, the camera
paths by `sample` in radiance mode alone, and compared pair of regions by pair of regions: Welch's t-test of batches.  Every third
point each has its shading normal tilted by 0, 25 and 50 degrees.
"""
from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_grid import BSDFS
from scipy import stats
from small_scenes import grey

from olpm_bench.check.verdict import sidak
from olpm_bench.transport import adjoint
from olpm_bench.transport.particles import evaluated, trace

LEVEL = 0.01                # probability that all tests of a BSDF together fail although nothing is wrong
BATCHES, N = 24, 3 << 14
TILTS = np.radians([0, 25, 50])
REGIONS = 8                 # of the sphere of directions
LEAST = 3e-3                # of the brightest pair of regions: darker pairs have too few samples for a t-test
MOST_SPREAD = 0.25          # of a pair's batches, relative: what has heavier tails is not normal enough


def _tilted(bsdf: dict[str, Any], **options: bool) -> dict[str, Any]:
    """A normal map whose normals all lean by 30 degrees."""
    normal = np.tile(np.float32([0.75, 0.5, 0.5 + 0.75 ** 0.5 / 2]), (2, 2, 1))
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(normal), "raw": True}
    return {"type": "normalmap", "normalmap": texture, "bsdf": bsdf, **options}


# By default a map of normals darkens what comes from near the horizon.  Of a specular sample that is known for where it goes,
# and not for where it came from, so these maps must do without.
PLAIN = {"use_shadowing_function": False, "flip_invalid_normals": False}
MAPPED = {
    "normalmap, diffuse": lambda: _tilted(grey(0.7)),
    "normalmap, conductor": lambda: _tilted({"type": "conductor"}, **PLAIN),
    "normalmap, dielectric": lambda: _tilted({"type": "dielectric"}, **PLAIN),
    "normalmap, roughdielectric": lambda: _tilted({"type": "roughdielectric", "alpha": 0.3}),
    "bumpmap, steep": lambda: BSDFS["bumpmap"]() | {"scale": 0.3},
}
ALL = BSDFS | MAPPED
QUICK = ("diffuse", "dielectric", "roughdielectric", "normalmap, diffuse", "normalmap, dielectric", "bumpmap, steep")


def by_adjoint(bsdf: mi.BSDF, si: mi.SurfaceInteraction3f, bs: mi.BSDFSample3f, weight: mi.Spectrum) -> mi.Spectrum:
    return adjoint.sample_weight(mi.BSDFPtr(bsdf), si, bs, weight, mi.Bool(True))


def by_shading_frame(bsdf: mi.BSDF, si: mi.SurfaceInteraction3f, bs: mi.BSDFSample3f, weight: mi.Spectrum) -> mi.Spectrum:
    """Veach 1997, eq. 5.19, as Mitsuba's `ptracer` has it."""
    wi_n, wo_n = (dr.dot(si.n, si.to_world(d)) for d in (si.wi, bs.wo))
    cos_i, cos_o = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(bs.wo)
    return weight * dr.select((wi_n * cos_i > 0) & (wo_n * cos_o > 0), dr.abs(cos_i * wo_n / (cos_o * wi_n)), 0)


def _points(sampler: mi.Sampler) -> mi.SurfaceInteraction3f:
    """Points of a square seen along uniform directions, with tilted shading normals."""
    square = mi.load_dict({"type": "scene", "square": {"type": "rectangle"}})
    u = 1.8 * sampler.next_2d() - 0.9
    si = square.ray_intersect(mi.Ray3f(mi.Point3f(u.x, u.y, 1), mi.Vector3f(0, 0, -1)))
    tilt = dr.gather(mi.Float, mi.Float(TILTS), dr.arange(mi.UInt32, N) % 3)
    turn = 2 * dr.pi * sampler.next_1d()
    si.sh_frame.n = mi.Normal3f(dr.sin(tilt) * dr.cos(turn), dr.sin(tilt) * dr.sin(turn), dr.cos(tilt))
    si.initialize_sh_frame()
    si.wi = mi.warp.square_to_uniform_sphere(sampler.next_2d())
    return si


def _binned(si: mi.SurfaceInteraction3f, value: mi.Spectrum, a: mi.Vector3f, o: mi.Vector3f) -> np.ndarray:
    """Sums over points with each tilt and pairs of regions, of what came along a uniform direction, times its cosine."""
    def region(d: mi.Vector3f) -> mi.UInt32:
        side, left = dr.select(d.z > 0, mi.UInt32(0), 1), dr.select(d.y > 0, mi.UInt32(0), 1)
        return 4 * side + 2 * left + dr.select(dr.abs(d.z) > 0.5, mi.UInt32(1), 0)

    # A sample of weight 0 may have no direction, and then weighs NaN
    flux = mi.luminance(value) * dr.abs(dr.dot(si.n, si.to_world(si.wi)))
    flux = dr.select(dr.all(dr.isfinite(a)) & dr.all(dr.isfinite(o)), flux, 0)
    key = (dr.arange(mi.UInt32, N) % 3 * REGIONS + region(a)) * REGIONS + region(o)
    return np.bincount(key.numpy(), flux.numpy(), 3 * REGIONS**2) / N


def _scatters_back(wi: mi.Vector3f, bs: mi.BSDFSample3f) -> mi.Bool:
    """Whether a map of normals lets a specular photon leave along `wi`: on the same side of both normals."""
    m = wi + bs.eta * bs.wo
    return (dr.squared_norm(m) < 1e-10) | (wi.z * m.z * dr.dot(m, wi) > 0)


class Flux(NamedTuple):
    """Of each batch, tilt and pair of regions."""
    photons: np.ndarray
    camera: np.ndarray      # of what photons can find
    missing: float          # share of the camera paths' that no photon is sampled for

    @property
    def p(self) -> float:
        """The least p-value of all pairs, corrected for their number."""
        mean = np.maximum(self.camera.mean(0), self.photons.mean(0))
        spread = np.maximum(self.camera.std(0), self.photons.std(0))
        used = (mean > LEAST * mean.max()) & (spread < MOST_SPREAD * mean)
        assert mean[used].sum() > 0.7 * mean.sum()
        p = stats.ttest_ind(self.photons[:, used], self.camera[:, used], equal_var=False).pvalue
        return 1 - (1 - np.nanmin(p)) ** used.sum()

    @property
    def ratio(self) -> float:
        return float(self.photons.sum() / self.camera.sum())


def flux(name: str, weigh: Callable[..., mi.Spectrum] = by_adjoint, batches: int = BATCHES) -> Flux:
    bsdf = mi.load_dict(ALL[name]())
    radiance, importance = (mi.BSDFContext(mode) for mode in (mi.TransportMode.Radiance, mi.TransportMode.Importance))
    sampler = mi.load_dict({"type": "independent"})
    photons, camera, all_camera = [], [], []
    first = 1000 * list(ALL).index(name)            # each BSDF has random numbers of its own: the tests are independent
    for batch in range(batches):
        sampler.seed(dr.opaque(mi.UInt32, first + 2 * batch), N)
        si = _points(sampler)
        bs, weight = bsdf.sample(importance, si, sampler.next_1d(), sampler.next_2d())
        photons.append(_binned(si, weigh(bsdf, si, bs, weight), si.wi, bs.wo))

        sampler.seed(dr.opaque(mi.UInt32, first + 2 * batch + 1), N)
        si = _points(sampler)
        bs, weight = bsdf.sample(radiance, si, sampler.next_1d(), sampler.next_2d())
        back = mi.SurfaceInteraction3f(si)
        back.wi = bs.wo
        value, pdf = bsdf.eval_pdf(importance, back, si.wi)
        specular = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        found = dr.select(specular, _scatters_back(si.wi, bs), (pdf > 0) & (dr.max(value) > 0))
        camera.append(_binned(si, dr.select(found, weight, 0), bs.wo, si.wi))
        all_camera.append(camera[-1].sum() + _binned(si, dr.select(found, 0, weight), bs.wo, si.wi).sum())
    return Flux(np.array(photons), np.array(camera), 1 - float(np.sum(camera) / np.sum(all_camera)))


def check(name: str) -> None:
    found = flux(name)
    print(f"{name:28} photons / camera paths {found.ratio:.4f}, p = {found.p:.2g}, without photons {found.missing:.2%}")
    assert found.p > sidak(LEVEL, len(ALL)), name
    assert found.ratio == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize("name", QUICK)
def test_photons_carry_what_camera_paths_see(name):
    check(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in ALL if name not in QUICK])
def test_photons_carry_what_camera_paths_see_whatever_scatters(name):
    check(name)


@pytest.mark.parametrize("name", ["normalmap, diffuse", "bumpmap, steep"])
def test_the_shading_frame_of_the_surface_is_not_enough(name):
    assert flux(name, by_shading_frame).p < 1e-6


@pytest.mark.parametrize("name", ["diffuse", "dielectric"])
def test_a_normal_tilted_by_interpolation_is_right_either_way(name):
    """Where the geometric and the shading normal see a direction from the same side."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, N)
    si, bsdf = _points(sampler), mi.load_dict(ALL[name]())
    bs, weight = bsdf.sample(mi.BSDFContext(mi.TransportMode.Importance), si, sampler.next_1d(), sampler.next_2d())
    ours, theirs = (weigh(bsdf, si, bs, weight).numpy() for weigh in (by_adjoint, by_shading_frame))
    same = (theirs > 0).all(0)
    assert same.mean() > 0.3
    np.testing.assert_allclose(ours[:, same], theirs[:, same], rtol=2e-3)


@pytest.mark.parametrize("lean", [30, -30])
def test_traced_photons_leave_a_map_of_normals_with_the_flux_of_the_closed_form(lean):
    """Light at 45 degrees on normals p that lean towards it or away, of a diffuse BSDF of albedo R.

    Radiance  R / pi (p . a) / (n . a)  for unit flux leaves to where both n and p see; the cosines there add up to
    pi (1 + n . p) / 2.
    """
    bsdf, n = _tilted(grey(0.7), **PLAIN), 1 << 16
    room = {"type": "sphere", "radius": 3, "flip_normals": True, "bsdf": grey(0)}
    scene = mi.load_dict({"type": "scene", "floor": {"type": "rectangle", "bsdf": bsdf}, "room": room}, optimize=False)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, n)
    u, angle = sampler.next_2d() - 0.5, np.radians(45)
    a = mi.Vector3f(float(np.copysign(np.sin(angle), lean)), 0, float(np.cos(angle)))
    rays = evaluated(mi.Ray3f(mi.Point3f(u.x, u.y, 0) + a, -a), mi.Spectrum(dr.ones(mi.Float, n)))
    particles = trace(scene, rays, sampler, None, 0.5, 4, mi.TransportMode.Importance)
    position, weight, _, _, _ = particles.read(particles.place)
    assert (position.z.numpy() > 0).all()
    expected = 0.7 * np.cos(np.radians(45 - lean)) / np.cos(angle) * (1 + np.cos(np.radians(lean))) / 2
    assert weight.numpy().sum() / n == pytest.approx(expected, rel=0.01)
