"""Samples and a density compared at all scales, down to cells that hold two points."""
from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import stats

from olpm_bench.check.density import ROUNDING
from olpm_bench.check.particles import vector
from representations.square import from_hemisphere

COARSEST, FINEST = 4, 12    # cells of 2^-4 to 2^-12 of the square's edge
FEWEST_CELLS = 10           # with more than one point: of fewer, the tail of the statistic is not that of chi-square


class Tosses:
    """Directions of samples and of proposals, each kept by chance so that nobody can tell one from the other.

    With x from sample(), y from a proposal q and f = pdf(), an x that is kept with probability q / (q + f) and a y that is kept
    with probability f / (q + f) both have a density proportional to f q / (q + f).  There are as many x as y, so in any region a
    point that was kept is an x or a y as if by the toss of a coin, however few points there are.  A grid whose cells are pooled
    until they hold enough points is blind to what is wrong within a pool, as mass is in slivers that are never sampled.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng, self.keys = rng, [np.zeros(0, np.uint64)]

    def add(self, is_sample: bool, group: np.ndarray, wo: np.ndarray, f: np.ndarray, q: np.ndarray) -> None:
        """Keep some of the directions [n, 3] of groups [n] with these densities [n], all of them x or all of them y."""
        own, other = (q, f) if is_sample else (f, q)
        kept = self.rng.random(len(wo)) * (own + other) < own
        place = group[kept].astype(np.uint64) << np.uint64(2 * FINEST) | _morton(wo[kept])
        self.keys.append(place << np.uint64(1) | np.uint64(is_sample))

    def tests(self, names: Sequence[str]) -> Iterator[tuple[float, str, int]]:
        """p-value, words, and a group to look at, of each test: of every group at every scale, and of all groups together.

        Of a cell with n points, a of them x, the mean of (2 a - n)^2 / n is 1 and its variance is 2 - 2 / n.  Sums over cells are
        compared with the multiple of a chi-square variable that has their mean and variance, and no lighter a tail.
        """
        key = np.sort(np.concatenate(self.keys))
        is_sample = (key & np.uint64(1)).astype(np.int64)
        for scale in range(COARSEST, FINEST + 1):
            cell = key >> np.uint64(1 + 2 * (FINEST - scale))
            first = np.flatnonzero(np.r_[True, cell[1:] != cell[:-1]])
            n = np.diff(np.r_[first, len(cell)])
            several = n > 1
            group, sampled = cell[first] >> np.uint64(2 * scale), np.add.reduceat(is_sample, first)
            group, sampled, n = group[several].astype(np.int64), sampled[several], n[several]
            uneven = np.maximum(np.abs(2 * sampled - n) - ROUNDING * n, 0) ** 2 / n
            sums = np.array([np.bincount(group, values, len(names)) for values in (np.ones(len(n)), uneven, 2 - 2 / n)])
            for index in range(-1, len(names)):
                cells, total, variance = sums.sum(1) if index < 0 else sums[:, index]
                if cells < FEWEST_CELLS:
                    continue
                words = (f"{'all records' if index < 0 else names[index]}: in {cells:.0f} cells of 1/{2**scale} of the square's "
                         f"edge, samples and the pdf differ {total / cells:.2f} times as much as by chance")
                shown = int((sums[1] - sums[0]).argmax()) if index < 0 else index
                yield float(stats.chi2.sf(total * 2 * cells / variance, 2 * cells**2 / variance)), words, shown


def _morton(wo: np.ndarray) -> np.ndarray:
    """A direction's cell on the finest grid of the square, so numbered that cells of one coarser cell are neighbours [n]."""
    x, y = np.clip((np.array(from_hemisphere(vector(wo))) * 2**FINEST).astype(np.int64), 0, 2**FINEST - 1).astype(np.uint64)
    return _spread(x) | _spread(y) << np.uint64(1)


def _spread(bits: np.ndarray) -> np.ndarray:
    """The bits of 16-bit numbers, with a zero before each."""
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    return bits
