"""pdf() is a density: finite, never negative, zero below the horizon, and of an integral of at most 1."""
from __future__ import annotations

import numpy as np
from scipy import stats

from olpm_bench.check.picture import of_record
from olpm_bench.check.population import MESH
from olpm_bench.check.trained import CORNERS, Trained
from olpm_bench.check.verdict import Failure, PValues, Verdict, exact

ROUNDING = 1e-3         # relative error that float32 is forgiven


def direction(wo: np.ndarray) -> str:
    return f"({wo[0]:.4g}, {wo[1]:.4g}, {wo[2]:.4g})"


def is_valid(trained: Trained) -> Verdict:
    """Finite, >= 0, and 0 below the horizon: at probes, around the particles, and at the samples."""
    records, found, total = trained.records, [], 0
    drawn, corners = trained.drawn, trained.corners
    for kind, a, pdf in (("probed", records.probes, trained.probes), ("proposed", records.proposed, trained.proposed),
                         ("sampled", drawn, drawn.pdf), (f"sampled ({CORNERS})", corners, corners.pdf)):
        total += len(pdf)
        for wrong, what in ((~np.isfinite(pdf), "not finite"), (pdf < 0, "negative"),
                            ((a.wo[:, 2] <= 0) & (pdf != 0), "not 0 below the horizon")):
            if wrong.any():
                i = int(np.flatnonzero(wrong)[0])
                words = (f"{records.name(a.record[i])}: pdf {pdf[i]:.4g} 1/sr at {direction(a.wo[i])}, {what}; "
                         f"{wrong.sum()} of {len(wrong)} {kind} directions")
                found.append(Failure(wrong.sum(), words, of_record(trained, a.record[i], a.wo[i])))
    return exact(found, "invalid densities", note=f"{total} densities of {len(records)} records")


def integral(trained: Trained, level: float) -> Verdict:
    """At most 1 by quadrature, and equal to the share of the samples that do not fail."""
    records, drawn, n = trained.records, trained.drawn, len(trained.records)
    ratio = trained.mesh / records.mesh.q
    first, second = (np.bincount(records.mesh.record, ratio**k, n) / MESH for k in (1, 2))
    variance = np.maximum(second - first**2, 0) / MESH         # of independent points: those of the mesh do better
    alive = np.bincount(drawn.record, drawn.alive, n) / records.counts
    alive_variance = alive * (1 - alive) / records.counts
    p_values = PValues()

    def add(name: str, some: list[int], shown: int) -> None:
        value, error = first[some].mean(), np.sqrt(variance[some].sum()) / len(some)
        sampled, sampled_error = alive[some].mean(), np.sqrt(alive_variance[some].sum()) / len(some)
        picture = of_record(trained, shown)
        words = f"{name}: the pdf integrates to {value:.4f} +- {error:.4f}"
        p_values.add(stats.norm.sf((value - 1 - ROUNDING) / max(error, 1e-12)), f"{words}, more than 1", picture)
        if records.complete[some].all():         # else the quadrature may miss narrow lobes
            difference = max(abs(value - sampled) - ROUNDING, 0)
            p_values.add(2 * stats.norm.sf(difference / max(np.hypot(error, sampled_error), 1e-12)),
                         f"{words}, but {sampled:.4f} +- {sampled_error:.4f} of the samples don't fail", picture)

    for record in range(n):
        add(records.name(record), [record], record)
    complete = np.flatnonzero(records.complete).tolist()
    if complete:
        add("all records", complete, max(complete, key=lambda r: abs(first[r] - alive[r])))
    note = f"{first.mean():.4f} +- {np.sqrt(variance.sum()) / n:.4f} by quadrature; {alive.mean():.4f} of the samples don't fail"
    return p_values.verdict(level, note)
