"""The records that the camera sees: through the middle of each pixel, the one that serves what the ray hits."""
from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.transport.camera_rays import sample_ray
from olpm_bench.transport.guide import MIN_PARTICLES, Guide
from olpm_bench.transport.guided_bsdf import incident_normal


@dataclass(frozen=True)
class RecordView:
    """All [height, width].

    surface: there is one that can be guided from: not all of it is specular.
    record: index; -1 where no record serves the surface, or where there is none.
    radius: validity radius, in units of the cache's r_max; NaN without a record.
    count: particles that the record has seen; 0 without one.
    """
    surface: np.ndarray
    record: np.ndarray
    radius: np.ndarray
    count: np.ndarray

    @property
    def guided(self) -> float:
        """Share of the surfaces whose record has seen enough particles to guide paths; 1 where there are none."""
        return float(np.mean(self.count[self.surface] >= MIN_PARTICLES)) if self.surface.any() else 1.0


def records_seen(scene: mi.Scene, guide: Guide, sensor: mi.Sensor | None = None) -> RecordView:
    """Look up the record at the first surface behind each pixel, also where no path would be guided."""
    sensor = sensor or scene.sensors()[0]
    film = sensor.film()
    width, height = film.crop_size()
    pixel = dr.arange(mi.UInt32, width * height)
    x, y = pixel % dr.opaque(mi.UInt32, width), pixel // dr.opaque(mi.UInt32, width)
    at = mi.Point2f((mi.Float(x) + 0.5) / width, (mi.Float(y) + 0.5) / height)
    ray, _ = sample_ray(sensor, 0.0, 0.5, at, mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    surface = si.is_valid() & mi.has_flag(si.bsdf(ray).flags(), mi.BSDFFlags.Smooth)
    record, _, valid = guide.cache.lookup(si.p, incident_normal(si), si.is_valid())
    found = np.broadcast_to(valid.numpy(), width * height)
    index = np.where(found, np.broadcast_to(record.numpy(), width * height).astype(int), -1)
    smooth = np.broadcast_to(surface.numpy(), width * height)
    radius, count = np.append(guide.cache.radii / guide.cache.radius, np.nan), np.append(guide.count.numpy(), 0)
    return RecordView(*(a.reshape(height, width) for a in (smooth, index, radius[index], count[index])))
