"""A guide: the cache finds the record, the representation holds its density, and this turns both to world space."""
from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

import representations
from olpm_bench.transport import headroom, npz, radius
from olpm_bench.transport.cache import RecordCache
from olpm_bench.transport.estimates import ENOUGH, Estimates
from olpm_bench.transport.roulette import PixelEstimate
from olpm_bench.transport.scene_checks import Fingerprint
from olpm_bench.transport.settings import InputError
from representations import state as states
from representations.interface import ParticleBatch
from representations.state import copied

if TYPE_CHECKING:
    from olpm_bench.transport.gather import Gathered

FORMAT = 5              # of guide files
MIN_PARTICLES = 80      # records that have seen fewer leave the surface to its BSDF; the mixture's first fit needs as many


class GuidedPoint:
    """The distribution that serves a surface point, in world space.

    Attributes:
        found: there is a record.
        valid: there is a record, and it has seen enough particles.
        fraction: its learnt BSDF fraction; 0: not learnt.
        outgoing: the mean radiance that it returns; -1: not known.
        reflected: and that with next-event estimation; 0: not known, or not asked for (`direct`).
        at: the point in the record's frame, or None without parallax.
    """

    def __init__(self, guide: Guide, record: mi.UInt32, frame: mi.Frame3f, found: mi.Bool,
                 at: mi.Vector3f | None = None) -> None:
        self.guide, self.record, self.frame, self.found, self.at = guide, record, frame, found, at
        row = dr.gather(mi.Vector4f, guide.rows, record, found)
        self.valid, self.fraction, self.outgoing = row.x > 0, row.y, dr.select(found, row.z, -1)
        self.reflected = row.w

    def sample(self, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool) -> tuple[mi.Vector3f, mi.Bool]:
        """A direction distributed by `pdf`, and whether there is one: samples may fail."""
        # With parallax the same mask as in `pdf`, so that one re-aiming serves both
        used = self.valid if self.at is not None else active & self.valid
        wo, _ = self.guide.representation.sample(self.guide.state, self.record, sample1, sample2, used, self.at)
        return self.frame.to_world(wo), active & (wo.z > 0)         # failed ones lie below the record's horizon

    def pdf(self, d: mi.Vector3f) -> mi.Float:
        """Density of a direction [1/sr]."""
        return self.guide.representation.pdf(self.guide.state, self.record, self.frame.to_local(d), self.valid, self.at)


class Guide:
    """Learnt distributions of incident radiance (or importance) over a scene's surfaces.

    Args:
        cache: where the records are.
        specification: the representation, as in a TOML: ``{"type": "gaussian_mixture", "components": 8}``.
        fraction: initial BSDF fraction of records that learn it; None: they do not.
        parallax: tell the representation where around a record it is asked, and where its particles landed.
        direct: learn direct light that next-event estimation finds too rarely.
        inherit: new records begin with what those beside them have learnt.
    """

    def __init__(self, cache: RecordCache, specification: dict[str, Any], fraction: float | None = None,
                 parallax: bool = False, direct: bool = False, inherit: bool = True) -> None:
        self.cache, self.specification, self.fraction, self.parallax = cache, specification, fraction, parallax
        self.direct, self.inherit = direct, inherit
        self.representation = representations.create(**specification)
        self.state = self.representation.init(0, 0, parallax)
        self.count = dr.zeros(mi.UInt32, 0)     # particles seen by each record, or by the one that it began as a copy of
        self.estimates = Estimates.nothing(0)
        self.rows = mi.Float()                  # [n_records * 4] for queries: has seen enough, fraction, outgoing, reflected
        self.pixels: PixelEstimate | None = None        # of the camera that the guide was trained for
        self.particles = 0                      # particles stored over all passes
        self.scene: Fingerprint | None = None           # that it was trained in; None: not known
        self.wanted = np.zeros(0, np.float32)   # radii that the last measured batch asks for [scene units]

    @property
    def records(self) -> int:
        return len(self.cache)

    @property
    def trained(self) -> float:
        """Share of the records that have seen `MIN_PARTICLES` and guide paths."""
        return float(np.mean(self.count.numpy() >= MIN_PARTICLES)) if self.records else 0.0

    @property
    def bytes_per_record(self) -> float:
        """Learned state only, in bytes."""
        return states.bytes_of(self.state) / max(self.records, 1)

    def at(self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool) -> GuidedPoint:
        """The distribution at a point with its normal, which looks to the side that light comes from."""
        record, normal, found = self.cache.lookup(p, n, active)
        frame = mi.Frame3f(normal)
        at = frame.to_local(p - self.cache.row(record, found)[0]) if self.parallax else None
        return GuidedPoint(self, record, frame, found, at)

    # ---------------------- Learning ----------------------

    def grow(self, p: mi.Point3f, n: mi.Normal3f, active: mi.Bool, seed: int) -> None:
        """Add records where the points have none."""
        before, added = self.records, self.cache.grow(p, n, active)
        if added:
            each = self.bytes_per_record if before else states.bytes_of(self.representation.init(2, 0, self.parallax)) / 2
            headroom.require((2 * before + added) * each, f"{before + added} records of {each:.0f} bytes",
                         "make record_radius larger, or the representation smaller")
            self.state = states.append(self.state, self.representation.init(added, seed, self.parallax))
            self.count = states.join(self.count, dr.zeros(mi.UInt32, added))
            self.estimates = states.append(self.estimates, Estimates.nothing(added))
            if self.inherit:
                self._inherit(before)
            dr.eval(self.state, self.count, self.estimates)
            self._tabulate()

    def _inherit(self, first: int) -> None:
        """Copy to the records from number `first` on what the older ones beside them, of the same frame, have learnt, and their
        count."""
        parent = self.cache.parents(first)
        child = np.flatnonzero(parent >= 0)
        if len(child) < 2:                      # a single one stays untrained: arrays of one entry compile other kernels
            return
        source, target = (copied(mi.UInt32, x.astype(np.uint32)) for x in (parent[child], first + child))
        self.count = states.copy_records(self.count, self.records, source, target)
        for state in (self.state, self.estimates):
            for f in fields(state):
                setattr(state, f.name, states.copy_records(getattr(state, f.name), self.records, source, target))

    def learn_fluence(self, batch: Gathered, emitted: int) -> None:
        """What the photons or importons of one pass, of which so many were `emitted`, tell of the fluence."""
        self.estimates.learn_fluence(batch, dr.square(batch.reach) * dr.opaque(mi.Float, emitted))

    def learn_particles(self, batch: ParticleBatch, seed: int) -> None:
        """One on-line update with the photons or importons of one pass."""
        if len(batch):
            self._update(self.estimates.normalise_particles(batch), seed)

    def learn_camera(self, batch: ParticleBatch, returned: mi.Float, chosen_by_bsdf: mi.Float, reflected: mi.Float,
                     offset: mi.UInt32, seed: int) -> None:
        """One on-line update with the camera paths of one pass.

        Args:
            batch: estimates of incident radiance.
            returned, chosen_by_bsdf, reflected, offset: of all vertices, see :meth:`Estimates.learn`.
        """
        self.estimates.learn(returned, chosen_by_bsdf, reflected, offset)
        if len(batch):
            batch = self.estimates.normalise_camera(batch)
        self._update(batch, seed)

    def _update(self, batch: ParticleBatch, seed: int) -> None:
        if len(batch):
            self.state = self.representation.update(self.state, batch, seed)
            self.count = self.count + batch.count()
            self.particles += len(batch)
            dr.eval(self.state, self.count)
        self._tabulate()

    def _tabulate(self) -> None:
        """Bring the rows for queries up to date."""
        c = self.estimates.fraction(self.fraction) if self.fraction is not None else dr.zeros(mi.Float, self.records)
        c = dr.select(self.estimates.by_either > 0, c, 0)
        outgoing = self.estimates.outgoing(self.cache.points, self.cache.radius)
        reflected = dr.select((self.estimates.visits >= ENOUGH) & self.direct, self.estimates.reflected, 0)
        self.rows = dr.ravel(mi.Vector4f(dr.select(self.count >= MIN_PARTICLES, mi.Float(1), 0), c, outgoing, reflected))
        dr.eval(self.rows)

    def fluence_at(self, p: mi.Point3f, n: mi.Normal3f) -> mi.Float:
        """Fluence [per emitted particle and area] at the record that serves a point; 0 where there is none."""
        record, _, found = self.cache.lookup(p, n, True)
        return dr.gather(mi.Float, self.estimates.fluence, record, found)

    def areas(self) -> mi.Float:
        """Area that each record serves, up to a factor [scene units^2]."""
        return copied(mi.Float, self.cache.radii ** 2)

    def measure(self, batch: Gathered) -> None:
        """Note the validity radii that a batch asks for."""
        self.wanted = radius.wanted(self.cache, batch)

    def shrink(self) -> None:
        """Shrink the records to the radii noted last: before the cache grows, so that gaps are filled at once."""
        self.cache.shrink(self.wanted)

    # ---------------------- Files ----------------------

    def save(self, path: str | Path) -> None:
        """Write the guide to a compressed ``.npz`` file, which takes the place of one that is there when it is whole."""
        meta = {"format": FORMAT, "representation": self.specification, "fraction": self.fraction, "parallax": self.parallax,
                "particles": self.particles, "scene": self.scene and dataclasses.asdict(self.scene)}
        arrays = {f"cache.{k}": v for k, v in self.cache.to_numpy().items()}
        arrays |= {f"state.{k}": v for k, v in states.to_numpy(self.state).items()}
        arrays |= {f"estimates.{k}": v for k, v in states.to_numpy(self.estimates).items()}
        if self.pixels is not None:
            arrays["pixels"] = self.pixels.luminance
        arrays |= {"meta": np.array(json.dumps(meta)), "count": self.count.numpy()}
        beside = Path(path).with_name(f".{Path(path).name}.{os.getpid()}.tmp")
        try:
            with open(beside, "wb") as file:
                np.savez_compressed(file, **arrays)     # type: ignore[arg-type]
            os.replace(beside, path)
        finally:
            beside.unlink(missing_ok=True)

    @staticmethod
    def load(path: str | Path, representation: str | None = None) -> Guide:
        """Read a guide.

        Args:
            representation: the type that it must be of.  FILE.py:Class, whose code is then run, must be given.

        Raises:
            InputError: not a whole guide file, one of a newer format, or of another type.
            OSError: it can't be read.
        """
        def part(prefix: str) -> dict[str, np.ndarray]:
            return {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}

        arrays = npz.read(path)
        try:
            meta = json.loads(str(arrays["meta"]))
            if meta["format"] != FORMAT:
                raise InputError(f"{path}: guide format {meta['format']}, this version reads {FORMAT}; train again")
            kind, fraction, parallax, particles = (meta["representation"]["type"], meta["fraction"], meta["parallax"],
                                                   meta["particles"])
            if representation is not None and kind != representation:
                raise InputError(f"{path} holds a guide of type '{kind}', not '{representation}'")
            if representation is None and representations.file_of(kind) is not None:
                raise InputError(f"{path} holds a guide of type '{kind}', whose code is run only if Guide.load is told this type")
            if not ((fraction is None or 0 < fraction <= 1) and isinstance(parallax, bool) and isinstance(particles, int)):
                raise ValueError("meta")
            guide = Guide(RecordCache.from_numpy(part("cache.")), meta["representation"], fraction, parallax)
            guide.state = _stored(part("state."), guide.representation.init(2, 0, parallax), guide.records)
            guide.estimates = _stored(part("estimates."), Estimates.nothing(2), guide.records)
            if "pixels" in arrays:
                h, w = arrays["pixels"].shape
                npz.require(np.isfinite(npz.checked(arrays, "pixels", np.float32, h, w)).all() and h * w > 0, "pixels")
                guide.pixels = PixelEstimate(arrays["pixels"])
            guide.count, guide.particles = mi.UInt32(npz.checked(arrays, "count", np.uint32, guide.records)), particles
            guide.scene = Fingerprint.from_json(meta.get("scene"))          # older files have none
            guide._tabulate()
            return guide
        except (InputError, representations.RepresentationError) as error:
            raise InputError(f"{'' if str(path) in str(error) else f'{path}: '}{error}") from error
        except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError, MemoryError) as error:
            raise InputError(f"{path}: not a whole guide file (.npz as written by Guide.save): {error}") from error

    def __repr__(self) -> str:
        return f"Guide[{self.specification}, {self.records} records ({self.trained:.0%} trained), {self.particles} particles]"


def _stored(arrays: dict[str, np.ndarray], like: Any, n_records: int) -> Any:
    """The state of so many records that is in a file; `like` is one of two records.

    Raises:
        ValueError: it is of other types or sizes.
    """
    for f in fields(like):
        two = getattr(like, f.name).numpy()
        npz.checked(arrays, f.name, two.dtype, n_records * (len(two) // 2))
    return states.from_numpy(like, arrays)
