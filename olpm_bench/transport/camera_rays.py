"""The rays of an image, and which of them a lane of the path tracer traces.

A packet of lanes runs until its longest path ends: with one path a lane half of them idle, for roulette by contribution ends
many paths early and keeps a few for long.  So a lane takes several samples of its pixel, one after the other (path
regeneration, Novák, Havran & Dachsbacher 2010): 8 of them save 8 to 16 % of the CPU time (dining-room, Veach Ajar; lanes of 16).
"""
from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

MOST_PATHS = 16         # of a lane; more of them save no more
LANES_AT_ONCE = 2 ** 15  # of a pixel: sums of no more than these Dr.Jit leaves to one thread
FEWEST_LANES = 2 ** 17  # of an image: cores take 2^14 at a time.  Not by the number of cores, on which no image may depend


def sums_samples(film: mi.Film) -> bool:
    """Whether a film needs no more of a pixel than the sum of its samples: not with an alpha channel, nor with a filter that
    spreads samples over pixels."""
    return film.rfilter().is_box_filter() and not mi.has_flag(film.flags(), mi.FilmFlags.Alpha) and not film.sample_border()


def paths_a_lane(sensor: mi.Sensor, spp: int) -> int:
    """How many samples of its pixel a lane can take: one where they must be told apart, and on a GPU, which many lanes keep
    busy."""
    film = sensor.film()
    if not sums_samples(film) or dr.backend_v(mi.Float) != dr.JitBackend.LLVM:
        return 1
    lanes, paths = int(dr.prod(film.crop_size())) * spp, 1
    while paths < MOST_PATHS and spp % (2 * paths) == 0 and lanes // (2 * paths) >= FEWEST_LANES:
        paths *= 2
    return paths


def sample_ray(sensor: mi.Sensor, time: mi.Float | float, wavelength: mi.Float | float, position: mi.Point2f,
               aperture: mi.Point2f, active: mi.Bool | bool = True) -> tuple[mi.Ray3f, mi.Spectrum]:
    """A ray of a sensor, and its weight; Mitsuba's `irradiancemeter` has rays with differentials only (3.9.1)."""
    if sensor.class_name() != "IrradianceMeter":
        return sensor.sample_ray(time, wavelength, position, aperture, active)
    ray, weight = sensor.sample_ray_differential(time, wavelength, position, aperture, active)
    return mi.Ray3f(ray), weight


class CameraRays:
    """Rays of one image, `paths_a_lane` from each lane; consecutive lanes have the same pixel.

    Args:
        sensor: camera with its film.
        spp: samples a pixel.
        paths_a_lane: a divisor of them.
    """

    def __init__(self, sensor: mi.Sensor, spp: int, paths_a_lane: int) -> None:
        film = sensor.film()
        self.sensor, self.paths_a_lane, self.lanes_a_pixel = sensor, paths_a_lane, spp // paths_a_lane
        border = film.rfilter().border_size() if film.sample_border() else 0
        size = film.crop_size() + 2 * border
        self.pixels, self.width, self.border = int(dr.prod(size)), dr.opaque(mi.UInt32, int(size[0])), border
        lanes = dr.arange(mi.UInt32, self.pixels * self.lanes_a_pixel)
        self.corner = self._corner(lanes // dr.opaque(mi.UInt32, self.lanes_a_pixel))
        self.scale = dr.rcp(mi.ScalarVector2f(film.crop_size()))
        self.uv = (self.corner + 0.5) * self.scale                                      # of its centre, in [0, 1]^2
        self.offset, self.box = mi.ScalarVector2f(film.crop_offset()), film.rfilter().is_box_filter()

    def _corner(self, pixel: mi.UInt32) -> mi.Point2f:
        """Of a pixel, within the crop window."""
        row = pixel // self.width
        return mi.Point2f(mi.Point2i(pixel - row * self.width, row) - self.border)

    def sum_pixels(self, L: mi.Spectrum) -> tuple[mi.Spectrum, mi.Point2f]:
        """Of each pixel the sum of its lanes, and where on the film it goes.

        In a fixed order: threads that add to a film, each to its own copy, add in an order that depends on their number.
        """
        lanes = self.lanes_a_pixel
        while lanes > 1:
            block = lanes if lanes <= LANES_AT_ONCE or lanes % 2 else math.gcd(lanes, LANES_AT_ONCE)
            L, lanes = dr.block_sum(L, block, mode="evaluated"), lanes // block
        return L, self._corner(dr.arange(mi.UInt32, self.pixels)) + self.offset

    def next(self, sampler: mi.Sampler, active: mi.Bool | bool = True) -> tuple[mi.Ray3f, mi.Spectrum, mi.Point2f]:
        """A ray through the lane's pixel, its weight, and where on the film [pixels] its radiance goes."""
        position = self.corner + sampler.next_2d(active)
        aperture = sampler.next_2d(active) if self.sensor.needs_aperture_sample() else mi.Point2f(0)
        time = mi.Float(self.sensor.shutter_open())
        if self.sensor.shutter_open_time() > 0:
            time += sampler.next_1d(active) * self.sensor.shutter_open_time()
        ray, weight = sample_ray(self.sensor, time, 0, position * self.scale, aperture, active)
        return ray, weight, (self.corner if self.box else position) + self.offset       # of the box, all are alike
