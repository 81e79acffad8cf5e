"""Weighted stepwise MAP expectation maximisation of Gaussian mixtures on the unit square, one mixture a lane.

On-line EM (Cappé & Moulines 2009; "stepwise" in Liang & Klein 2009) as Vorba et al. 2014 use it: every particle moves
running statistics by a step eta = (k + 1)^-alpha, every tenth sets the mixture to their maximum a posteriori.
A first fit sweeps its particles until the likelihood settles; later batches are swept once and forgotten.

One change of substance.  The M-step's n is not the number of visits but the *effective number* of particles in the
statistics, (sum of shares)^2 / sum of squared shares: on-line EM forgets, and weights differ.  And the prior's b
grows with the dispersion D of the weights, as (1 + D)^2: heavy particles are noisy estimates, to which lobes would shrink.  On
the camera paths of Veach Ajar both together raised the mean ln pdf of held-out ones from -1.241 to -1.184 (one run); equal
weights keep b.

Two changes of form.  *Relative statistics*: u_j, m_j and S_j are kept divided by the mean
weight wbar, so that they are of order one whatever the unit of flux:

    wbar' = (1 - eta) wbar + eta w,  rho = eta w / wbar',  u_j' = (1 - rho) u_j + rho gamma_j,  and so on.

*Moving pivot*: moments are taken about the component's current mean, and shifted when that moves.  Then m_j = 0 and
S_j = D_j after every M-step, only u_j and D_j need keeping, and nothing cancels: as the paper writes it, D_j is the
difference of numbers near one, and float32 gives the sun's disk (det Sigma = 6e-13) a negative determinant.
"""
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import drjit as dr
import mitsuba as mi

Particle: TypeAlias = "tuple[mi.Float, mi.Float, mi.Float, mi.Float]"   # point on the square, weight, 1 / distance
Particles: TypeAlias = "Callable[[mi.UInt32], Particle]"            # particle i of each lane

INITIAL_VISITS = 100        # what the initial mixture counts for, in particles: with 0 it is forgotten in ten [M]
M_STEP_EVERY = 10           # an M-step after the very first particle would put all means on it [M]
UNROLLED = 2
CLAMP_ROUNDS = 4            # fixed-point iterations for the mean of clamped weights
WIDE_VARIANCE = 0.1         # of the one wide component of the initial mixture
EXPONENT = 0.5 / dr.log(2)  # exp(-d^2 / 2) = 2^(-EXPONENT d^2)
LOG_NORM = -dr.log(2 * dr.pi * EXPONENT)


@dataclass
class Lobes:
    """K Gaussians: N(s) proportional to 2^-|R (s - mean)|^2, R upper triangular. Each field [K, n]."""
    weight: mi.ArrayXf      # sum over K is 1
    mean_x: mi.ArrayXf
    mean_y: mi.ArrayXf
    r_xx: mi.ArrayXf        # R^T R = Sigma^-1 / (2 ln 2)
    r_xy: mi.ArrayXf
    r_yy: mi.ArrayXf


@dataclass
class Statistics:
    """What EM remembers besides the lobes."""
    mass: mi.ArrayXf        # u_j / wbar [K, n], sum over K is 1
    d_xx: mi.ArrayXf        # D_j / wbar [K, n], about the means of the lobes
    d_xy: mi.ArrayXf
    d_yy: mi.ArrayXf
    near: mi.ArrayXf | None # sum of gamma / distance, as u_j / wbar sums gamma [K, n]: near / mass is 1 / harmonic mean
    mean_weight: mi.Float   # wbar [n], in the unit of the particles' weights
    squares: mi.Float       # sum of the squared shares that particles have in the statistics [n]; 1 / their effective number
    visits: mi.UInt32       # k [n]


def exp2_negative(x: mi.ArrayXf) -> mi.ArrayXf:
    """2^x for x <= 0, and 2^-126 below that; relative error 2e-7, in half the instructions of `dr.exp2` on a CPU."""
    x = dr.maximum(x, -126)
    shifted = x + 12582912.0                                # 1.5 * 2^23: the low bits are now round(x)
    f = x - (shifted - 12582912.0)                          # in [-1/2, 1/2]
    y = dr.fma(f, 1.32647e-3, 9.67151e-3)                   # minimax polynomial of 2^f
    for coefficient in (5.550734e-2, 2.4022242e-1, 6.9314698e-1, 1.0):
        y = dr.fma(y, f, coefficient)
    bits = dr.reinterpret_array(mi.ArrayXi, y) + (dr.reinterpret_array(mi.ArrayXi, shifted) << 23)
    return dr.reinterpret_array(mi.ArrayXf, bits)


class StepwiseEM:
    """The algorithm and its constants; see :class:`representations.gaussian_mixture.GaussianMixture`."""

    def __init__(self, components: int, alpha: float, a: float, b: float, v: float, eigenvalue_floor: float,
                 max_sweeps: int, tolerance: float, weight_clamp: float, start_variance: float) -> None:
        self.components = components
        self.alpha = alpha
        self.a, self.b, self.v = a, b, v
        self.eigenvalue_floor = eigenvalue_floor
        self.weight_clamp = weight_clamp
        self.max_sweeps = max_sweeps
        self.tolerance = tolerance
        self.start_variance = start_variance

    @dr.syntax
    def online(self, particles: Particles, count: mi.UInt32, lobes: Lobes, statistics: Statistics) -> tuple[Lobes, Statistics]:
        """One sweep over the `count` particles of each lane."""
        i, left = mi.UInt32(0), mi.UInt32(count)
        while dr.hint(left > 0, mode="symbolic", label="on-line EM"):
            ten = dr.minimum(left, M_STEP_EVERY)
            lobes, statistics, _, _ = self._step(particles, i, ten, lobes, statistics, None)
            i += ten
            left -= ten
        return lobes, statistics

    @dr.syntax
    def first_fit(self, particles: Particles, count: mi.UInt32, positive: mi.Float, rng: mi.PCG32,
                  parallax: bool = False) -> tuple[Lobes, Statistics]:
        """Sweep all `count` particles of each lane, `positive` of them with a weight > 0, until the mean log likelihood
        changes by less than `tolerance`, relative.  With `parallax` distances are learnt as well."""
        mean_weight = self._mean_weight(particles, count, positive)
        lobes, statistics = self.start(particles, count, mean_weight, rng, parallax)
        sweep, before, settled = mi.UInt32(0), mi.Float(dr.inf), mi.Bool(False)
        while dr.hint((sweep < self.max_sweeps) & ~settled, mode="symbolic", label="first fit"):
            i, likelihood, weights = mi.UInt32(0), mi.Float(0), mi.Float(0)
            while dr.hint(i < count, mode="symbolic"):
                ten = dr.minimum(count - i, M_STEP_EVERY)
                lobes, statistics, likelihood_ten, weights_ten = self._step(particles, i, ten, lobes, statistics, positive)
                likelihood += likelihood_ten
                weights += weights_ten
                i += ten
            now = likelihood / weights * dr.log(2) + LOG_NORM
            settled = dr.abs(now - before) <= self.tolerance * dr.abs(now)
            before = now
            sweep += 1
        return lobes, statistics

    @dr.syntax
    def _mean_weight(self, particles: Particles, count: mi.UInt32, positive: mi.Float) -> mi.Float:
        """Mean of the positive weights, those above `weight_clamp` times that mean cut there."""
        mean, rounds = mi.Float(dr.inf), mi.UInt32(0)
        while dr.hint(rounds < CLAMP_ROUNDS, mode="symbolic", label="mean weight"):
            i, total = mi.UInt32(0), mi.Float(0)
            while dr.hint(i < count, mode="symbolic"):
                weight = particles(i)[2]
                total += dr.minimum(weight, self.weight_clamp * mean) / positive
                i += 1
            mean = total
            rounds += 1
        return mean

    @dr.syntax
    def start(self, particles: Particles, count: mi.UInt32, mean_weight: mi.Float, rng: mi.PCG32,
              parallax: bool = False) -> tuple[Lobes, Statistics]:
        """k-means++ centres (Arthur & Vassilvitskii 2007) for all components but one, which is wide."""
        centres: list[tuple[mi.Float, mi.Float]] = []
        for _ in range(self.components - 1):
            # Weighted reservoir sampling: a particle is the centre with probability w d^2, d to the nearest one so far
            x, y = rng.next_float32(), rng.next_float32()
            i, total = mi.UInt32(0), mi.Float(0)
            while dr.hint(i < count, mode="symbolic", label="k-means++"):
                px, py, weight = particles(i)[:3]
                w = dr.minimum(weight / mean_weight, self.weight_clamp)
                nearest = mi.Float(1e30) if centres else mi.Float(1)
                for cx, cy in centres:
                    nearest = dr.minimum(nearest, dr.square(px - cx) + dr.square(py - cy))
                w *= nearest
                total += w
                taken = rng.next_float32() * total < w
                x, y = dr.select(taken, px, x), dr.select(taken, py, y)
                i += 1
            centres.append((x, y))
        lanes = dr.width(mean_weight)
        shape = (self.components, lanes)
        mean_x = mi.ArrayXf([*(c[0] for c in centres), dr.full(mi.Float, 0.5, lanes)])
        mean_y = mi.ArrayXf([*(c[1] for c in centres), dr.full(mi.Float, 0.5, lanes)])
        variance = mi.ArrayXf([*(dr.full(mi.Float, self.start_variance, lanes) for _ in centres),
                               dr.full(mi.Float, WIDE_VARIANCE, lanes)])
        mass = dr.full(mi.ArrayXf, 1 / self.components, shape)
        r = dr.sqrt(EXPONENT / variance)
        zero = dr.zeros(mi.ArrayXf, shape)
        return (Lobes(mass, mean_x, mean_y, r, zero, mi.ArrayXf(r)),
                Statistics(mi.ArrayXf(mass), mass * variance, mi.ArrayXf(zero), mass * variance,
                           mi.ArrayXf(zero) if parallax else None, mi.Float(mean_weight),
                           dr.full(mi.Float, 1 / INITIAL_VISITS, lanes), dr.full(mi.UInt32, INITIAL_VISITS, lanes)))

    @dr.syntax
    def _step(self, particles: Particles, first: mi.UInt32, count: mi.UInt32, lobes: Lobes, statistics: Statistics,
              limit: mi.Float | None) -> tuple[Lobes, Statistics, mi.Float, mi.Float]:
        """E-steps for `count` particles, then an M-step with n = min(k, limit).

        The products of (1 - eta) are divided out of the sums: with c_q = eta_q w_q / (wbar prod_{l<=q} (1 - eta_l)),
        u_j' = (u_j + sum_q c_q gamma_qj) / (1 + sum_q c_q), which spares a multiplication a statistic and particle.

        Returns the new state, and the sums of w log2 p and of w over the particles (w relative to wbar).
        """
        scale = dr.rcp(statistics.mean_weight)
        log_norm = dr.log2(lobes.weight * lobes.r_xx * lobes.r_yy)

        # Closures, so that the loop below does not carry what it leaves unchanged
        def particle(q: mi.UInt32) -> Particle:
            x, y, weight, inverse = particles(first + dr.minimum(q, count - 1))
            return x, y, dr.select(q < count, dr.minimum(weight * scale, self.weight_clamp), 0), inverse

        def log_density(x: mi.Float, y: mi.Float) -> tuple[mi.ArrayXf, mi.ArrayXf, mi.ArrayXf]:
            d_x, d_y = x - lobes.mean_x, y - lobes.mean_y
            q_x, q_y = dr.fma(lobes.r_xx, d_x, lobes.r_xy * d_y), lobes.r_yy * d_y
            return dr.fma(-q_x, q_x, dr.fma(-q_y, q_y, log_norm)), d_x, d_y

        mass, d_xx, d_xy, d_yy, near = statistics.mass, statistics.d_xx, statistics.d_xy, statistics.d_yy, statistics.near
        m_x, m_y = dr.zeros(mi.ArrayXf, dr.shape(mass)), dr.zeros(mi.ArrayXf, dr.shape(mass))
        total, squares, likelihood, weights = mi.Float(1), mi.Float(statistics.squares), mi.Float(0), mi.Float(0)
        k, keep = mi.Float(statistics.visits + 1), mi.Float(1)
        eta = dr.exp2(-self.alpha * dr.log2(k))
        q, left = mi.UInt32(0), mi.UInt32(count)
        while dr.hint(left > 0, mode="symbolic"):
            for j in range(UNROLLED):
                x, y, w, inverse = particle(q + j)
                # E-step in the log domain
                log_p, r_x, r_y = log_density(x, y)
                peak = dr.max(log_p, axis=0)
                p = exp2_negative(log_p - peak)
                p_sum = dr.sum(p, axis=0)
                likelihood += w * (peak + dr.log2(p_sum))
                weights += w
                # Statistics.  A zero weight teaches nothing, and is no visit
                keep *= dr.select(w > 0, 1 - eta, 1)
                step = eta * w / keep
                total += step
                squares = dr.fma(step, step, squares)
                c = p * (step / p_sum)
                c_x, c_y = c * r_x, c * r_y
                mass = mass + c
                m_x = m_x + c_x
                m_y = m_y + c_y
                d_xx = dr.fma(c_x, r_x, d_xx)
                d_xy = dr.fma(c_x, r_y, d_xy)
                d_yy = dr.fma(c_y, r_y, d_yy)
                near = None if near is None else dr.fma(c, inverse, near)
                # eta = k^-alpha for the next k: (k / (k + 1))^alpha, up to terms in k^-3, and k > 100
                eta *= dr.select(w > 0, 1 - self.alpha * dr.rcp(k + 0.5 * (1 + self.alpha)), 1)
                k += dr.select(w > 0, mi.Float(1), 0)
            q += UNROLLED
            left -= dr.minimum(left, UNROLLED)
        # Move the pivots to the new means
        shift_x, shift_y = m_x / dr.maximum(mass, 1e-30), m_y / dr.maximum(mass, 1e-30)
        norm = dr.rcp(total)
        statistics = Statistics(
            mass * norm, norm * dr.maximum(dr.fma(-m_x, shift_x, d_xx), 0), norm * dr.fma(-m_x, shift_y, d_xy),
            norm * dr.maximum(dr.fma(-m_y, shift_y, d_yy), 0), None if near is None else norm * near,
            statistics.mean_weight * keep * total, dr.square(norm) * squares,
            statistics.visits + mi.UInt32(k - mi.Float(statistics.visits + 1) + .5))
        n = dr.rcp(statistics.squares)
        mode = self._maximise(statistics, n if limit is None else dr.minimum(n, limit), lobes.mean_x + shift_x,
                              lobes.mean_y + shift_y)
        lobes = dr.select(total > 1, mode, lobes)        # nothing learnt: keep the density
        return lobes, statistics, likelihood, weights

    def _maximise(self, statistics: Statistics, n: mi.Float, mean_x: mi.ArrayXf, mean_y: mi.ArrayXf) -> Lobes:
        """M-step: the posterior's mode under an inverse Wishart (a, b) and a Dirichlet (v) prior, n observations."""
        evidence = n * statistics.mass
        scale = dr.rcp(self.a - 2 + evidence)
        # Equal weights would make 2 / eta - 1 effective particles; `ratio` is 1 + the dispersion of the weights
        ratio = dr.maximum((2 * mi.Float(statistics.visits) ** self.alpha - 1) * statistics.squares, 1)
        b = self.b * dr.square(ratio)
        s_xx = dr.fma(n, statistics.d_xx, b) * scale
        s_yy = dr.fma(n, statistics.d_yy, b) * scale
        s_xy = n * statistics.d_xy * scale
        # Eigenvalues centre +- radius, raised to the floor with the eigenvectors kept
        centre, half = 0.5 * (s_xx + s_yy), 0.5 * (s_xx - s_yy)
        radius = dr.sqrt(dr.square(half) + dr.square(s_xy))
        high = dr.maximum(centre + radius, self.eigenvalue_floor)
        low = dr.maximum(centre - radius, self.eigenvalue_floor)
        stretch = 0.5 * (high - low) / dr.maximum(radius, 1e-30)
        centre, half, s_xy = 0.5 * (high + low), half * stretch, s_xy * stretch
        s_xx, s_yy = centre + half, centre - half
        # R^T R = Sigma^-1 / (2 ln 2), upper triangular
        r_yy = dr.rsqrt(s_yy)
        r_xx = dr.sqrt(s_yy / (high * low))
        return Lobes((evidence + (self.v - 1)) / (n + self.components * (self.v - 1)), mean_x, mean_y,
                     r_xx * dr.sqrt(EXPONENT), -s_xy * r_yy * r_yy * r_xx * dr.sqrt(EXPONENT), r_yy * dr.sqrt(EXPONENT))
