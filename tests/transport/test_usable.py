"""NaN, infinite and negative values of a scene: training leaves them out, counts them, and refuses when they are most."""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from olpm_bench.check.small_scenes import box, grey, lamp
from olpm_bench.transport import settings
from olpm_bench.transport.particles import evaluated
from olpm_bench.transport.settings import InputError
from olpm_bench.transport.training import Training
from olpm_bench.transport.usable import TOLERATED, require_usable, usable
from representations import state as states

FEW = settings.training(passes=2, photons=4000, importons=2000, camera_passes=2, camera_paths=2000, record_radius=0.1)
PATHS = settings.integrator(max_depth=5)
ODD = (np.nan, np.inf, -1.0)


@pytest.mark.parametrize("odd", ODD)
def test_odd_values_are_not_usable(odd):
    assert list(usable(mi.Color3f([1.0, odd, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]))) == [True, False, True]


def test_few_are_dropped_some_are_told_and_most_are_refused():
    assert require_usable(6, 100_000, "photons") == ""
    assert "more than 0.1% of the photons" in require_usable(int(2 * TOLERATED * 100_000), 100_000, "photons")
    with pytest.raises(InputError, match="51 of 100 photons are NaN"):
        require_usable(51, 100, "photons")


def test_emitted_particles_that_are_odd_are_counted_and_weigh_nothing():
    origin, direction = mi.Point3f(dr.zeros(mi.Float, 6)), mi.Vector3f(0, 0, mi.Float([1, 1, 1, 1, np.nan, 1]))
    weight = mi.Color3f(mi.Float([2, np.nan, np.inf, -1, 2, 2]))
    rays = evaluated(mi.Ray3f(origin, direction), weight)
    assert rays.unusable == 4
    np.testing.assert_array_equal(rays.weight.x.numpy(), [2, 0, 0, 0, 0, 2])
    assert np.isfinite(rays.ray.d.numpy()).all()
    assert rays.unit[0] == pytest.approx(4 / 6)


def spoilt(n: int, odd: float, value: float = 0.6) -> dict:
    """A texture of 32 x 32 texels, of which n are odd."""
    texels = np.full((32, 32, 3), value, np.float32)
    texels.reshape(-1, 3)[np.random.default_rng(1).permutation(1024)[:n]] = odd
    return {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "nearest"}


def learnt(scene: mi.Scene) -> tuple[int, list[str], dict[str, np.ndarray]]:
    """How many values were left out, what was told, and everything that the guides have learnt."""
    training = Training(scene, "gaussian_mixture", FEW, PATHS)
    passes = list(training.run())
    arrays = {}
    for name, guide in (("radiance", training.radiance), ("importance", training.importance)):
        for part in (guide.state, guide.estimates):
            arrays |= {f"{name} {field}": array for field, array in states.to_numpy(part).items()}
        arrays[f"{name} query"] = guide.rows.numpy()
    return sum(p.unusable for p in passes), [w for p in passes for w in p.warnings], arrays


@pytest.mark.parametrize("odd", [np.nan, np.inf])
def test_guides_of_a_scene_with_a_few_odd_texels_stay_finite(odd):
    scene = mi.load_dict(box({"type": "diffuse", "reflectance": spoilt(2, odd)}, lamp=lamp()), optimize=False)
    unusable, told, arrays = learnt(scene)
    assert unusable > 0
    assert any("are NaN, infinite or negative and teach nothing" in warning for warning in told)
    for name, array in arrays.items():
        assert np.isfinite(array).all(), name
    assert arrays["radiance returned"].max() > 0


def test_a_scene_without_odd_values_has_none():
    unusable, told, _ = learnt(mi.load_dict(box(grey(0.6), lamp=lamp()), optimize=False))
    assert unusable == 0
    assert not any("NaN" in warning for warning in told)


def test_a_scene_of_nothing_but_odd_values_is_refused():
    scene = mi.load_dict(box({"type": "diffuse", "reflectance": spoilt(1000, np.nan)}, lamp=lamp()), optimize=False)
    with pytest.raises(InputError, match="are NaN, infinite or negative: look for such values"):
        learnt(scene)
