"""Damping and Coulomb friction of a free device, estimated from sweeps at several speeds.

While the handle moves in one direction, Newton's law m·x'' + b·x' + c·sign(x') + f0 = F holds for its position x and
the motor's force F along it: mass, damping, Coulomb friction, a constant force such as weight. Weighted by w(t) =
sin²(π t/L) over an interval of length L, which vanishes with its slope at both ends, and integrated by parts,

    ∫wF = m·∫w''x - b·∫w'x + c·sign·∫w + f0·∫w,

which is linear in the parameters and does not differentiate the encoder signal (Shinbrot 1954). If the residuals reject
this law, one with an additional term is used, or none (`friction_laws`). Least squares over the sweeps; intervals by a
bootstrap over whole periods, there and back, because errors of one sweep (cogging, servo oscillation) recur in the next
(block bootstrap, Künsch 1989). Units: mm, N, s, b in N·s/m, m in kg.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from hilbo.errors import InputError
from hilbo.hardware_bridge import DeviceError
from hilbo.identification.motor.friction_laws import LAWS, Blocks, Law, candidates, refuted

__all__ = ["Friction", "Interval", "Sweep", "friction", "sweeps"]

_FEWEST = 8  # periods
_DRAWS = 4000
_AS_WELL = 1.25  # times the least sum of squares, up to which a law fits about as well
_CREEPS = 0.008  # s after a turn until the handle moves


class Sweep(NamedTuple):
    """Weighted means over one sweep: force (N), velocity (mm/s), acceleration (mm/s²); and the number of its period."""

    force: float
    velocity: float
    acceleration: float
    period: int


class Interval(NamedTuple):
    """Estimate with its 95 % interval."""

    value: float
    lower: float
    upper: float


class Friction(NamedTuple):
    """Friction of a free device; `residual` (N) is the standard deviation of the residuals of the sweeps.

    `law` is one of `friction_laws.LAWS`, `added` the additional term of the second (N·s²/m²) or third (N), whose v_s is
    `speed` (mm/s). The interval of the damping covers those of all laws that fit about as well.
    """

    damping: Interval  # N·s/m
    coulomb: Interval  # N
    mass: Interval  # kg
    constant: Interval  # N
    residual: float
    sweeps: int
    periods: int
    law: str = LAWS[0]
    added: Interval | None = None
    speed: float | None = None


def sweeps(
    position: Float[np.ndarray, " n"],
    force: Float[np.ndarray, " n"],
    tick: float,
    period: float,
    settle: float,
    number: int = 0,
) -> list[Sweep]:
    """Split the record of a triangular drive, which starts at its middle and rises, into sweeps.

    Each direction gives two sweeps: the `settle` s after the turn, where the servo oscillates and the mass matters, and
    the rest. `force` (N) is the motor's, along the position (mm); samples every `tick` s; `period` (s) of the drive.
    `number`: number of the first period, to join several records. Raises `InputError` for sweeps shorter than twice
    `settle`.
    """
    half, skip = round(period / 2 / tick), round(settle / tick)
    recorded, starts = [], range(round(period / 4 / tick), position.size - half + 1, half)  # where the triangle turns
    if half < 2 * skip:
        raise InputError(f"The sweeps are too short: {half * tick:.3g} s, and the first {settle:.3g} s are the turn.")
    for count, start in enumerate(starts):
        half_period = position[start : start + half]
        # The handle turns later than the triangle, and at_turn there until friction releases it.
        at_turn = np.flatnonzero(
            half_period == (half_period.max() if half_period[0] > half_period[-1] else half_period.min())
        )
        turn = start + int(at_turn[-1]) + round(_CREEPS / tick)
        for first, end in ((turn, turn + skip), (turn + skip, start + half)):
            recorded.append(_sweep(position[first:end], force[first:end], tick, number + count // 2))
    return recorded


def _sweep(x: Float[np.ndarray, " n"], force: Float[np.ndarray, " n"], tick: float, period: int) -> Sweep:
    """Weighted means of one sweep of positions `x` (mm) and forces (N), sampled every `tick` s; `period`: its number.

    A force is constant from its sample to the next.
    """
    turns = 2 * np.pi * np.arange(x.size) / (x.size - 1)
    length, mid_turns = (x.size - 1) * tick, (turns[:-1] + turns[1:]) / 2
    # w = (1 - cos)/2. The origin of x is arbitrary, since w'' and w' have integral 0; centred for precision.
    x = x - x.mean()
    mean_force = np.sum((1 - np.cos(mid_turns)) * force[:-1]) * tick / length
    ends = (x[0] + x[-1]) / 2  # the trapezoid rule, for w'' that does not vanish there
    curvature = np.sum(np.cos(turns) * x) - ends
    velocity = -(2 * np.pi / length**2) * tick * np.sum(np.sin(turns) * x)
    acceleration = (2 * np.pi / length) ** 2 * tick / length * curvature
    return Sweep(float(mean_force), float(velocity), float(acceleration), period)


def friction(sweeps: Sequence[Sweep], seed: int = 0) -> Friction:
    """Estimate friction by least squares over the sweeps, by the simplest law that fits.

    Intervals by bootstrap over periods. Raises `InputError` for fewer than 8 periods or a single speed, and
    `DeviceError` if every law is rejected.
    """
    values = np.array([[s.force, s.velocity, s.acceleration] for s in sweeps])
    periods, period = np.unique([s.period for s in sweeps], return_inverse=True)
    if periods.size < _FEWEST or np.unique(np.abs(values[:, 1]).round(0)).size < 2:
        raise InputError(
            f"There are {periods.size} periods of sweeps; at least {_FEWEST}, at two speeds or more, are needed"
            " to distinguish damping from friction."
        )
    # N = kg m/s^2 + (N s/m) m/s + N + N, from mm/s^2 and mm/s
    terms = np.stack([values[:, 2] / 1e3, values[:, 1] / 1e3, np.sign(values[:, 1]), np.ones(len(values))], axis=1)
    fits = _fitting(Blocks(terms, values[:, 0], period), np.abs(values[:, 1]), np.sign(values[:, 1]))
    law, blocks = fits[0]
    mass, damping, coulomb, constant, *added = _intervals(blocks, seed)
    for _, other in fits[1:]:
        again = _intervals(other, seed)[1]
        damping = Interval(damping.value, min(damping.lower, again.lower), max(damping.upper, again.upper))
    freedom = blocks.terms.shape[1]
    residual, added_term = float(blocks.left.std(ddof=freedom)), added[0] if added else None
    parts = damping, coulomb, mass, constant
    return Friction(*parts, residual, len(sweeps), int(periods.size), law.name, added_term, law.speed)


def _fitting(blocks: Blocks, speed: Float[np.ndarray, " n"], way: Float[np.ndarray, " n"]) -> list[tuple[Law, Blocks]]:
    """Laws that fit the sweeps, simplest first, each with its least-squares problem.

    Only the simplest law if it is not rejected; else those within 1.25 times the least sum of squares. `speed` in mm/s;
    `way`: direction, 1 or -1. Raises `DeviceError` if every law is rejected.
    """
    simplest, *others = candidates(speed, way)
    if not refuted(blocks, speed, way):
        return [(simplest, blocks)]
    pairs = [(law, blocks.with_term(law)) for law in others]
    left = [float(np.sum(pair[1].left ** 2)) for pair in pairs]
    order = np.argsort(left)  # best first
    good = [pairs[i] for i in order if left[i] < _AS_WELL * left[order[0]] and not refuted(pairs[i][1], speed, way)]
    if not good:
        raise DeviceError(
            f"The friction of this device follows none of the laws that are known ({', '.join(LAWS)}): the sweeps leave"
            f" {1e3 * blocks.left.std():.1f} mN that change with the speed, so that no damping is given. Look for"
            " something that rubs or is loose, and measure again; until then plan no study with this device."
        )
    return sorted(good, key=lambda pair: LAWS.index(pair[0].name))  # the simpler law first; stable


def _intervals(blocks: Blocks, seed: int) -> list[Interval]:
    """Estimates of all terms, in their order, with basic 95 % bootstrap intervals over periods."""
    count, best = int(blocks.period.max()) + 1, blocks.best
    products = blocks.terms[:, :, None] * blocks.terms[:, None, :]
    sums = np.zeros((count, *products.shape[1:])), np.zeros((count, best.size))
    np.add.at(sums[0], blocks.period, products)
    np.add.at(sums[1], blocks.period, blocks.terms * blocks.force[:, None])
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), _DRAWS)
    normal, right = np.tensordot(drawn, sums[0], 1), drawn @ sums[1]
    estimates = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
    # Basic bootstrap, widened for the small number of blocks as a t-interval is.
    wide = np.sqrt(count / (count - best.size))
    lower, upper = best - wide * (np.quantile(estimates, [0.975, 0.025], axis=0) - best)
    return [Interval(*map(float, row)) for row in zip(best, lower, upper, strict=True)]
