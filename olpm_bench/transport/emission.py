"""Guided emission of lights at infinity: environments (constant, envmap, sunsky) and directional lights [T 113-117].

Photons of such a light start anywhere on the disk that the scene's bounding sphere shows to it, and in a building nearly
all of them end on the roof.  Importons that leave the scene show where to start:

    p(omega, x) = alpha p_own(omega) / (pi R^2) + (1 - alpha) p(omega) p(x | omega),    weight = radiance / p

* p(omega): a raster of equal area, 1000 x 500 cells in all as in the original [L], but laid over two hemispheres by the
  square map instead of longitude and height, whose cells are slivers at the poles.  The light's own radiance is known and
  tabulated in its cells; importons x radiance are counted in *blocks* of 5 x 5 cells (1.4 degrees), few enough to be met
  often.  The radiance at the sampled direction itself is in the weight: the raster may be rough, e.g. about the sun's edge.
* p(x | omega): Gaussian mixtures by stepwise EM on a disk perpendicular to omega, a record for each block, each *area* of
  5 x 5 blocks and each *zone* of 5 x 5 areas; the finest that has seen enough importons serves.  The disk is equal-area mapped
  to the hemisphere of :class:`representations.gaussian_mixture.GaussianMixture`.  Our choice: the guided disk is as large as
  what the importons leave through, not as the scene, which may stand on a plain.
* A directional light has one direction, and one record.
* alpha: the defensive share keeps the estimate unbiased and weights below 1 / alpha of unguided ones.
"""
from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from olpm_bench.transport.cache import MISSING
from olpm_bench.transport.guide import MIN_PARTICLES
from olpm_bench.transport.light_sampling import LightSampling
from olpm_bench.transport.mis import balance_weight, density
from olpm_bench.transport.particles import Departures, ParticleRays, evaluated
from representations import discrete, square
from representations import state as states
from representations.gaussian_mixture import GaussianMixture
from representations.interface import ParticleBatch
from representations.state import copied

BLOCK = 5                           # edge of a block in cells, of an area in blocks, of a zone in areas
ZONES = 4                           # along the edge of a hemisphere's square
AREAS, BLOCKS, CELLS = (ZONES * BLOCK ** i for i in (1, 2, 3))
N_ZONES, N_AREAS, N_BLOCKS, N_CELLS = (2 * edge ** 2 for edge in (ZONES, AREAS, BLOCKS, CELLS))
N_KEYS = N_BLOCKS + N_AREAS + N_ZONES       # what can have a record, besides the directional lights
CELL_SOLID_ANGLE = 4 * np.pi / N_CELLS      # [sr]
SUPERSAMPLING = 4                   # of the light's radiance, along the edge of a cell
SMOOTH = 0.2                        # share of the importance that is spread over the area
FINE = 400                          # importons from which on the record of a block or area serves, not that of the next larger
EVEN = 0.2                          # share of positions that are uniform on the guided disk
ENOUGH = 100_000                    # importons of a pass that are learnt from
MOST = 2000                         # of these a record takes
CLAMP = 100                         # heavier importons count as this many times the pass's mean weight
INNER = 0.99                        # of the importance leaves through the guided disk
SMALLEST = 1e-5                     # radius of the guided disk / of the scene: of a smaller one float32 can't tell the points
OUTSIDE = 0.1                       # of that of a later pass beside it, from which on there is a new one


def distant_lights(scene: mi.Scene) -> list[mi.Emitter]:
    """The lights at infinity; the environment, if there is one, comes first."""
    lights = [e for e in scene.emitters() if mi.has_flag(e.flags(), mi.EmitterFlags.Infinite)]
    return sorted(lights, key=lambda e: not e.is_environment())


class EmissionGuide:
    """Learns from departing importons where photons of the lights at infinity should start, and starts them there.

    Args:
        scene: with at least one light at infinity (`distant_lights`).
        bounds: box around all surfaces.
        fraction: defensive share alpha of the light's own sampler, in (0, 1].
    """

    def __init__(self, scene: mi.Scene, bounds: mi.ScalarBoundingBox3f, fraction: float) -> None:
        self.scene, self.fraction = scene, fraction
        self.lights = distant_lights(scene)
        self.light_sampling = LightSampling(scene)
        self.has_environment = self.lights[0].is_environment()
        self.center = mi.Point3f([dr.opaque(mi.Float, float(x)) for x in np.array(bounds.center()).ravel()])
        self.radius = 0.5 * float(dr.norm(bounds.extents())) * (1 + 1e-4)           # [scene units]
        self.disk = dr.opaque(mi.Float, self.radius)
        self.representation = GaussianMixture()
        self.state = self.representation.init(0)
        self.seen = np.zeros(0, np.int64)                                           # importons of each record
        self.records = np.full(N_KEYS + len(self.lights), MISSING, np.uint32)       # of blocks, areas, zones, lights
        self.importance = np.zeros(N_BLOCKS)                                        # x radiance of each block, over all passes
        self.waiting: list[np.ndarray] | None = []                                  # importons before there is a guided disk
        self.guided_center, self.guided_radius = self.center, self.disk             # of the guided disk
        self.learnt, self.unguided = False, len(self.lights)                        # lights whose photons nothing guides

    def _tabulate_radiance(self) -> None:
        """Mean luminance in each cell of the raster, as shares of its block."""
        cell = dr.arange(mi.UInt32, N_CELLS)
        radiance = dr.zeros(mi.Float, N_CELLS)
        for i in range(SUPERSAMPLING ** 2):
            offset = [dr.opaque(mi.Float, (k + 0.5) / SUPERSAMPLING) for k in divmod(i, SUPERSAMPLING)]
            value = mi.luminance(self._radiance(_direction_in(cell, mi.Point2f(offset))))
            radiance += dr.select(dr.isfinite(value), dr.maximum(value, 0), 0)
            dr.eval(radiance)
        shares = radiance.numpy().reshape(N_BLOCKS, -1).astype(float)
        total = shares.sum(1, keepdims=True)
        self.dark = total[:, 0] <= 0
        shares = np.divide(shares, total, out=np.zeros_like(shares), where=total > 0)
        self.power = total[:, 0]                                        # of a block, up to a factor
        self.share = copied(mi.Float, shares.ravel().astype(np.float32))
        self.share_sums = copied(mi.Float, np.cumsum(shares, 1).ravel().astype(np.float32))

    def _radiance(self, d: mi.Vector3f) -> mi.Spectrum:
        """Of the environment, seen along d."""
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(d))
        si.wi = -d
        return self.lights[0].eval(si)

    # ---------------------- What importons see ----------------------

    def index(self, emitter: mi.EmitterPtr) -> mi.UInt32:
        """Which of `lights` an emitter is; len(lights): none of them."""
        index = mi.UInt32(len(self.lights))
        for i, light in enumerate(self.lights):
            index = dr.select(emitter == mi.EmitterPtr(light), mi.UInt32(i), index)
        return index

    def escape(self, si: mi.SurfaceInteraction3f, pdf: mi.Float, active: mi.Bool) -> tuple[mi.Spectrum, mi.Float]:
        """Radiance that a ray out of the scene meets, and its share against next-event estimation.

        Args:
            si: of the ray, invalid.
            pdf: density with which its direction was chosen [1/sr].
        """
        if not self.has_environment:
            return mi.Spectrum(0), mi.Float(0)
        ds = mi.DirectionSample3f(self.scene, si, dr.zeros(mi.Interaction3f))
        em_pdf = self.scene.pdf_emitter_direction(dr.zeros(mi.Interaction3f), ds, active)
        return ds.emitter.eval(si, active), balance_weight(pdf, em_pdf)

    # ---------------------- Learning ----------------------

    def learn(self, departures: Departures, seed: int) -> None:
        """One on-line update with the importons that left the scene in one pass."""
        new = np.stack([x.numpy() for x in (*departures.position, *departures.direction, departures.weight,
                                            departures.light)]).astype(np.float32)
        new = new[:, ::-(-new.shape[1] // ENOUGH) or 1]         # evenly spaced ones
        if new.shape[1] == 0:
            return
        if self.waiting is not None:
            self.waiting.append(new)
            new = np.concatenate(self.waiting, axis=1)
            if new.shape[1] < MIN_PARTICLES:
                return
            self.waiting = None
            if self.has_environment:
                self._tabulate_radiance()
            self._aim(new)
        weight = np.minimum(new[6], CLAMP * new[6].mean())
        p, d = mi.Point3f([copied(mi.Float, x) for x in new[:3]]), mi.Vector3f([copied(mi.Float, x) for x in new[3:6]])
        light = new[7].astype(np.int64)
        block = _cell(d).numpy().astype(np.int64) // BLOCK ** 2
        wo, inside = self._to_hemisphere(p, d)
        if weight[~inside.numpy()].sum() > OUTSIDE * weight.sum():          # they have found another way out: begin again
            self._aim(new)
            self.records[:], self.seen, self.state = MISSING, np.zeros(0, np.int64), self.representation.init(0)
            wo, inside = self._to_hemisphere(p, d)
        wo = np.stack([x.numpy() for x in wo])

        # Each teaches the records of its block, area and zone, or that of its directional light
        environment = (light == 0) & self.has_environment
        self.importance += np.bincount(block[environment], weight[environment], N_BLOCKS)
        area = _parent(block, BLOCKS)
        key = np.concatenate([np.where(environment, block, N_KEYS + light), N_BLOCKS + area,
                              N_BLOCKS + N_AREAS + _parent(area, AREAS)])
        entry = np.flatnonzero(np.concatenate([inside.numpy(), *2 * [inside.numpy() & environment]]))
        entry = entry[np.argsort(key[entry], kind="stable")]
        keys, start, found = np.unique(key[entry], return_index=True, return_counts=True)
        rank, found = np.arange(len(entry)) - np.repeat(start, found), np.repeat(found, found)
        entry = entry[rank * np.minimum(found, MOST) % found < np.minimum(found, MOST)]     # evenly spaced ones
        if len(entry) == 0:
            return
        self._add_records(keys, seed)
        record = self.records[key[entry]]
        entry %= len(light)
        batch = ParticleBatch.from_arrays(
            mi.Vector3f([copied(mi.Float, x) for x in wo[:, entry]]), copied(mi.Float, weight[entry].astype(np.float32)),
            copied(mi.UInt32, record), len(self.seen))
        self.state = self.representation.update(self.state, batch, seed)
        self.seen += np.bincount(record, minlength=len(self.seen))
        dr.eval(self.state)
        self._tabulate()

    def _aim(self, departures: np.ndarray) -> None:
        """Centre and radius of the guided disk: the point nearest to all rays, and what holds nearly all of them.

        Least squares, sum w |(1 - d d^T)(p - c)|^2 (and a little |p - c|^2, for parallel rays): if all rays pass one window,
        that is where it is, and seen from there positions hardly depend on the direction.
        """
        p, d = departures[:3].astype(float), departures[3:6].astype(float)
        weight = np.minimum(departures[6], CLAMP * departures[6].mean())
        weight = weight / weight.sum()
        across = np.eye(3)[..., None] * (1 + 1e-3) - d[:, None] * d
        center = np.linalg.solve(np.einsum("ijn,n->ij", across, weight), np.einsum("ijn,jn,n->i", across, p, weight))
        away = p - center[:, None]
        distance = np.linalg.norm(away - d * (away * d).sum(0), axis=0)
        order = np.argsort(distance, kind="stable")
        last = min(int(np.searchsorted(np.cumsum(weight[order]), INNER)), len(order) - 1)
        radius = 1.05 * distance[order[last]]
        self.guided_center = mi.Point3f([dr.opaque(mi.Float, x) for x in center])
        self.guided_radius = dr.opaque(mi.Float, float(np.clip(radius, SMALLEST * self.radius, self.radius)))

    def _add_records(self, keys: np.ndarray, seed: int) -> None:
        new = keys[self.records[keys] == MISSING]
        if len(new):
            self.records[new] = len(self.seen) + np.arange(len(new))
            self.state = states.append(self.state, self.representation.init(len(new), seed))
            self.seen = np.concatenate([self.seen, np.zeros(len(new), np.int64)])

    def _tabulate(self) -> None:
        """What `emit` reads: density and sums of the blocks, the record that serves each block or directional light."""
        # With a last entry for what has no record
        seen, records = np.append(self.seen, 0), np.minimum(self.records, len(self.seen))
        blocks, areas, zones, lights = np.split(np.where(seen[records] >= MIN_PARTICLES, self.records, MISSING),
                                                np.cumsum([N_BLOCKS, N_AREAS, N_ZONES]))
        fine_blocks, fine_areas = np.split(seen[records][:N_BLOCKS + N_AREAS] >= FINE, [N_BLOCKS])
        areas = np.where(fine_areas, areas, zones[_parent(np.arange(N_AREAS), AREAS)])
        blocks = np.where(fine_blocks, blocks, areas[_parent(np.arange(N_BLOCKS), BLOCKS)])
        self.serving = copied(mi.UInt32, np.concatenate([blocks, lights]).astype(np.uint32))
        guided = lights != MISSING
        if self.has_environment:
            importance = np.where(self.dark, 0, self.importance)
            area = _parent(np.arange(N_BLOCKS), BLOCKS)
            power = np.bincount(area, self.power, N_AREAS)
            spread = np.divide(np.bincount(area, importance, N_AREAS), power, out=np.zeros(N_AREAS), where=power > 0)
            importance = (1 - SMOOTH) * importance + SMOOTH * spread[area] * self.power
            guided[0] = importance.sum() > 0
            mass = importance / max(importance.sum(), 1e-300)
            self.mass = copied(mi.Float, mass.astype(np.float32))
            self.mass_sums = copied(mi.Float, np.cumsum(mass).astype(np.float32))
        self.own_share = copied(mi.Float, np.where(guided, self.fraction, 1).astype(np.float32))
        self.learnt, self.unguided = True, int(np.sum(~guided))

    # ---------------------- Emission ----------------------

    def emit(self, sampler: mi.Sampler) -> ParticleRays:
        """Rays that leave the emitters, weight = flux; in place of `emit_photons`."""
        index, choice, sample1 = self.scene.sample_emitter(sampler.next_1d(), True)
        emitter = dr.gather(mi.EmitterPtr, self.scene.emitters_dr(), index)
        sample2, sample3 = sampler.next_2d(), sampler.next_2d()
        light = self.index(emitter)
        distant = light < len(self.lights)
        ray, weight = self.light_sampling.sample_ray(emitter, sample1, sample2, sample3, ~distant)

        # ---------------------- The light's own sampler ----------------------
        nowhere = dr.zeros(mi.Interaction3f, dr.width(light))
        ds, irradiance = emitter.sample_direction(nowhere, sample2, distant)
        d, disk = mi.Vector3f(ds.d), self.disk * mi.warp.square_to_uniform_disk_concentric(sample3)
        x = self.center + mi.Frame3f(d).to_world(mi.Vector3f(disk.x, disk.y, 0))
        environment = distant & ~ds.delta

        # ---------------------- The guide's ----------------------
        if self.learnt:
            own_share = dr.gather(mi.Float, self.own_share, light, distant)
            guided = distant & (sampler.next_1d() >= own_share)
            if self.has_environment:
                d = dr.select(guided & environment, self._sample_direction(sampler.next_1d(), sample2), d)
            record = self._serving(d, light, environment, distant)
            guided_x, found = self._sample_position(d, record, sampler.next_1d(), sample3, guided)
            x = dr.select(guided, guided_x, x)
            failed = guided & ~found

        # ---------------------- Radiance and density ----------------------
        from_center = x - self.center
        from_center -= d * dr.dot(from_center, d)
        ds.d = d
        own_pdf = dr.select(dr.norm(from_center) <= self.disk * (1 + 1e-5), 1 / (dr.pi * dr.square(self.disk)), 0)
        own_pdf *= dr.select(environment, density(emitter.pdf_direction(nowhere, ds, environment)), 1)
        pdf = own_pdf
        if self.learnt:
            guided_pdf = self._position_pdf(x, d, record)
            if self.has_environment:
                guided_pdf *= dr.select(environment, self._direction_pdf(d), 1)
            pdf = dr.select(failed, 0, dr.lerp(guided_pdf, own_pdf, own_share))
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(light))
        si.wi = -d
        radiance = dr.select(environment, emitter.eval(si, environment), irradiance)
        ray = mi.Ray3f(dr.select(distant, self.center + from_center + d * self.disk, ray.o), dr.select(distant, -d, ray.d))
        weight = choice * dr.select(distant, dr.select(pdf > 0, radiance / pdf, 0), weight)
        return evaluated(ray, weight)

    def _sample_direction(self, sample1: mi.Float, sample2: mi.Point2f) -> mi.Vector3f:
        """A block, a cell in it, a point in that."""
        zero = dr.zeros(mi.UInt32, dr.width(sample1))
        target = sample1 * discrete.total(self.mass_sums, N_BLOCKS, zero)
        block = discrete.choose(self.mass_sums, N_BLOCKS, zero, target)
        before = dr.select(block > 0, dr.gather(mi.Float, self.mass_sums, dr.maximum(block, 1) - 1), 0)
        within = dr.clip((target - before) / dr.gather(mi.Float, self.mass, block), 0, dr.one_minus_epsilon(mi.Float))
        cell = discrete.choose(self.share_sums, BLOCK ** 2, block, within * discrete.total(self.share_sums, BLOCK ** 2, block))
        return _direction_in(block * BLOCK ** 2 + cell, sample2)

    def _direction_pdf(self, d: mi.Vector3f) -> mi.Float:
        """[1/sr]"""
        cell = _cell(d)
        mass = dr.gather(mi.Float, self.mass, cell // BLOCK ** 2) * dr.gather(mi.Float, self.share, cell)
        return mass / CELL_SOLID_ANGLE

    def _serving(self, d: mi.Vector3f, light: mi.UInt32, environment: mi.Bool, active: mi.Bool) -> mi.UInt32:
        """The record of positions for a direction; MISSING: none has seen enough."""
        key = dr.select(environment, _cell(d) // BLOCK ** 2, N_BLOCKS + light)
        return dr.select(active, dr.gather(mi.UInt32, self.serving, key, active), MISSING)

    def _sample_position(self, d: mi.Vector3f, record: mi.UInt32, sample1: mi.Float, sample2: mi.Point2f,
                         active: mi.Bool) -> tuple[mi.Point3f, mi.Bool]:
        """A point of the guided disk perpendicular to d, and whether there is one: samples may fail."""
        recorded = (record != MISSING) & (sample1 >= EVEN)
        sample1 = dr.clip((sample1 - EVEN) / (1 - EVEN), 0, dr.one_minus_epsilon(mi.Float))
        wo, _ = self.representation.sample(self.state, dr.select(recorded, record, 0), sample1, sample2, active & recorded)
        disk = mi.Point2f(wo.x, wo.y) * dr.rsqrt(dr.maximum(1 + wo.z, 1e-6))
        disk = dr.select(recorded, disk, mi.warp.square_to_uniform_disk_concentric(sample2))
        disk *= self.guided_radius
        x = self.guided_center + mi.Frame3f(d).to_world(mi.Vector3f(disk.x, disk.y, 0))
        return x, ~recorded | (wo.z > 0)

    def _position_pdf(self, x: mi.Point3f, d: mi.Vector3f, record: mi.UInt32) -> mi.Float:
        """[1 / area of the plane perpendicular to d]"""
        recorded = record != MISSING
        wo, inside = self._to_hemisphere(x, d)
        pdf = self.representation.pdf(self.state, dr.select(recorded, record, 0), wo, recorded)
        even = 1 / dr.pi
        return dr.select(inside, dr.select(recorded, dr.lerp(2 * pdf, even, EVEN), even) / dr.square(self.guided_radius), 0)

    def _to_hemisphere(self, x: mi.Point3f, d: mi.Vector3f) -> tuple[mi.Vector3f, mi.Bool]:
        """Where x lies on the guided disk perpendicular to d, mapped to the hemisphere; and whether it does.  Equal-area: a
        density per solid angle is R^2 / 2 times that on the disk."""
        local = mi.Frame3f(d).to_local(x - self.guided_center) / self.guided_radius
        r2 = dr.square(local.x) + dr.square(local.y)
        stretch = dr.safe_sqrt(2 - r2)
        return mi.Vector3f(local.x * stretch, local.y * stretch, 1 - r2), r2 < 1


# ---------------------- The raster: cells are numbered block by block ----------------------

def _cell(d: mi.Vector3f) -> mi.UInt32:
    """Cell of a direction."""
    s = square.from_hemisphere(d) * CELLS
    x, y = (dr.minimum(mi.UInt32(a), CELLS - 1) for a in s)
    block = (dr.select(d.z < 0, mi.UInt32(BLOCKS), 0) + y // BLOCK) * BLOCKS + x // BLOCK
    return (block * BLOCK + y % BLOCK) * BLOCK + x % BLOCK


def _direction_in(cell: mi.UInt32, offset: mi.Point2f) -> mi.Vector3f:
    """The direction at an offset in [0, 1)^2 within a cell."""
    x, rest = cell % BLOCK, cell // BLOCK
    y, block = rest % BLOCK, rest // BLOCK
    bx, by = block % BLOCKS, block // BLOCKS
    below = by >= BLOCKS
    corner = mi.Point2f(bx * BLOCK + x, dr.select(below, by - BLOCKS, by) * BLOCK + y)
    d = square.to_hemisphere((corner + offset) / CELLS)
    return mi.Vector3f(d.x, d.y, dr.select(below, -d.z, d.z))


def _parent(block: np.ndarray, edge: int) -> np.ndarray:
    """The next larger block that holds a block; `edge`: blocks along the edge of a hemisphere's square."""
    return block // edge // BLOCK * (edge // BLOCK) + block % edge // BLOCK
