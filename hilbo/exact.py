"""The exact ordinal posterior, by sampling with a stated standard error: the yardstick for the approximations.

With z = f + noise * e an ordinal answer is the event that z_i lies between two thresholds. All answers together are a
box of z ~ N(0, S), S = K + noise^2 I = L L', and f given z is Gaussian, so that with x = L^-1 z

    p(answers) = P(box),   E f* = k*' L^-T E[x],   Var f* = k** - |L^-1 k*|^2 + k*' L^-T Cov[x] L^-1 k*,

expectations over the box. They are sampled by minimax exponential tilting: coordinate after coordinate, x_i is drawn
from N(mu_i, 1) confined to what its interval leaves, with the weight exp(psi(x, mu)),

    psi(x, mu) = sum_i [mu_i^2 / 2 - mu_i x_i + log P(N(mu_i, 1) in interval_i(x_1 .. x_{i-1}))],

concave in x and convex in mu. At its saddle point the weights vary little even for improbable boxes, and none exceeds
exp(psi*), so that taking x with probability exp(psi - psi*) gives independent exact draws. The variables are ordered
by how improbable their intervals are, and the uniform numbers are scrambled Sobol points: independent scrambles are
the replicates from which the standard errors come.

Good to about 100 answers. Any tilting gives a right answer with an honest error; a poor one a large error.
References: Botev (2017), JRSS B 79:125; Genz (1992), J. Comput. Graph. Stat. 1:141; Gibson, Glasbey & Elston (1994)
for the order; Matousek (1998) for the scramble.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from hilbo.errors import InputError
from hilbo.likelihoods import confined_normal
from hilbo.linalg import _one_at_a_time, cholesky, eigh, solve_lower, solve_lower_transposed
from hilbo.normal import HALF_LOG_2PI, excess_hazard

__all__ = ["ExactPosterior", "SamplingCertificate", "exact"]

_REPLICATES = 32


class SamplingCertificate(eqx.Module):
    """What a sampled answer can say of its own accuracy."""

    residual: Float[Array, ""]
    """The larger of the two standard errors below."""
    tolerance: Float[Array, ""]
    """What is still called exact: 0.02."""
    log_evidence_error: Float[Array, ""]
    """Standard error of the log evidence."""
    mean_error: Float[Array, ""]
    """Largest standard error of a latent mean at an asked point, in prior standard deviations."""
    effective_samples: Float[Array, ""]
    """Squared sum of the weights over their sum of squares."""
    iterations: Int[Array, ""]
    """Newton steps to the tilting, rejected ones included."""
    jitter: Float[Array, ""]
    """Largest amount, of 1, by which a sampled variance exceeded the prior's; the excess is dropped."""
    converged: Bool[Array, ""]
    """residual <= tolerance."""


class _Box(eqx.Module):
    """The box in x, variables ordered: edges and Lower are in units of L's diagonal, Lower without its ones."""

    lower: Float[Array, " n"]
    upper: Float[Array, " n"]
    below: Float[Array, "n n"]
    half: Float[Array, "n n"]
    """L^-1, its columns in the caller's order, its rows 0 where there is no answer."""
    answered: Bool[Array, " n"]


class _Tilt(eqx.Module):
    mu: Float[Array, " n"]
    highest: Float[Array, ""]
    """psi*, which psi(x, mu) never exceeds."""
    gradient: Float[Array, ""]
    iterations: Int[Array, ""]


class ExactPosterior(eqx.Module):
    """Moments of p(f | answers) in the form of the other posteriors, and the samples behind them."""

    mode: Float[Array, " n"]
    """Posterior mean of the latent values at the asked points."""
    weights: Float[Array, " n"]
    factor: Float[Array, "n n"]
    inverse: Float[Array, "n n"]
    log_evidence: Float[Array, ""]
    certificate: SamplingCertificate
    samples: Float[Array, "n R B"]
    """x of every replicate, 0 where there is no answer."""
    shares: Float[Array, "R B"]
    """The weight of each sample over all weights; they sum to 1."""
    box: _Box
    tilt: _Tilt

    def expectation(
        self,
        of: Callable[[Float[Array, ""], Float[Array, ""]], Float[Array, "*out"]],
        cross: Float[Array, " n"],
        prior_variance: Float[Array, ""],
    ) -> tuple[Float[Array, "*out"], Float[Array, "*out"]]:
        """Posterior expectation of a function of f* and its standard error.

        **Arguments:** `of`: mean and variance of a normal f* -> its expectation under that normal; `cross` (n,) and
        `prior_variance`: prior covariances of f* with the latent values, and its own variance.
        """
        along = self.box.half @ cross
        values = jax.vmap(jax.vmap(lambda mean: of(mean, prior_variance - along @ along)))(
            jnp.tensordot(along, self.samples, 1)
        )
        return _weighted(self.shares, values)

    def moment_errors(
        self, cross: Float[Array, "n m"]
    ) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Standard errors of the posterior means and variances at m points."""

        def one(along):
            at = jnp.tensordot(along, self.samples, 1)
            mean, error = _weighted(self.shares, at)
            return error, _weighted(self.shares, (at - mean) ** 2)[1]

        return jax.lax.map(one, (self.box.half @ cross).T)

    def draw(
        self, key: PRNGKeyArray, cross: Float[Array, "n m"], prior: Float[Array, "m m"], count: int
    ) -> Float[Array, "count m"]:
        """Independent exact draws of the latent function at m points; NaN if the tilting was not found.

        `cross` (n, m) and `prior` (m, m) are prior covariances with the latent values and among the m points.
        """
        accept, finish = jax.random.split(key)
        along = self.box.half @ cross
        eigenvalues, vectors = eigh(prior - along.T @ along)
        root = vectors * jnp.sqrt(jnp.where(eigenvalues > 0, eigenvalues, 0.0))[None, :]
        x = _accepted(accept, self.box, self.tilt, count)
        return x @ along + jax.random.normal(finish, (count, cross.shape[1]), x.dtype) @ root.T


@eqx.filter_custom_jvp
def exact(
    key: PRNGKeyArray,
    covariance: Float[Array, "n n"],
    lower: Float[Array, " n"],
    upper: Float[Array, " n"],
    noise: Float[Array, ""],
    answered: Bool[Array, " n"],
    samples: int = 512 * _REPLICATES,
) -> ExactPosterior:
    """The posterior of f ~ N(0, K) given that f + noise * e lies between `lower` and `upper` where `answered`.

    **Arguments:**

    - `key`: another key gives other samples, that is another error of the stated size.
    - `covariance`: K, (n, n), of whatever rank; the noise makes the rest of the matrix definite.
    - `lower`, `upper`: edges (n,), infinite at the ends.
    - `samples`: in all, a power of 2 times 32. The error falls a little less than in proportion to their number.

    **Returns:** an [`ExactPosterior`][]. It has no derivatives: asked for one, `exact` raises `InputError`.
    """
    box = _ordered_box(covariance, lower, upper, noise, answered)
    tilt = _tilting(box)
    uniform = _sobol(key, samples // _REPLICATES, covariance.shape[0], covariance.dtype)
    x, psi = _propose(box, tilt.mu, uniform.reshape(-1, covariance.shape[0]).T)
    x = jnp.where(box.answered[:, None], x, 0.0).reshape(-1, _REPLICATES, samples // _REPLICATES)
    relative = jnp.exp(psi - tilt.highest).reshape(x.shape[1:])
    total = jnp.sum(relative)
    shares = relative / total
    mean, _ = _weighted(shares, jnp.moveaxis(x, 0, -1))
    narrowed, excess = _narrowed(x, shares, mean, box.answered)
    factor = narrowed @ box.half
    weights = box.half.T @ mean
    log_evidence = tilt.highest + jnp.log(total / samples)
    certificate = _certificate(covariance, box, tilt, x, shares, excess)
    return ExactPosterior(
        covariance @ weights, weights, factor, factor.T @ factor, log_evidence, certificate, x, shares, box, tilt
    )  # fmt: skip


@exact.def_jvp
def _exact_jvp(primals, tangents):
    raise InputError('inference "exact" is sampled and has no derivatives; use "ep" where they are needed.')


def _narrowed(x, shares, mean, answered):
    """A root of I - Cov[x], and the largest eigenvalue of Cov[x] - I: the box is convex, so that all beyond 0 is
    sampling error."""
    apart = x - mean[:, None, None]
    lessened = jnp.diag(answered.astype(x.dtype)) - jnp.tensordot(apart * shares[None], apart, [(1, 2), (1, 2)])
    eigenvalues, vectors = eigh(lessened)
    root = jnp.sqrt(jnp.where(eigenvalues > 0, eigenvalues, 0.0))[:, None] * vectors.T
    return root, jnp.where(eigenvalues[0] < 0, -eigenvalues[0], 0.0)


def _certificate(covariance, box, tilt, x, shares, excess):
    total = jnp.sum(shares, axis=1)
    log_error = jnp.std(total, ddof=1) / jnp.mean(total) / total.shape[0] ** 0.5
    latent = jnp.moveaxis(x, 0, -1) @ (box.half @ covariance)
    mean_error = jnp.max(_weighted(shares, latent)[1] / jnp.sqrt(jnp.diagonal(covariance)))
    worst = jnp.maximum(log_error, mean_error)
    tolerance = jnp.asarray(0.02, x.dtype)
    return SamplingCertificate(
        residual=worst,
        tolerance=tolerance,
        log_evidence_error=log_error,
        mean_error=mean_error,
        effective_samples=1.0 / jnp.sum(shares**2),
        iterations=tilt.iterations,
        jitter=excess,
        converged=worst <= tolerance,
    )


def _weighted(shares, values):
    """Weighted mean of `values` (R, B, ...) and its standard error, from the replicates, as of a ratio of two means."""
    weight = shares.reshape(shares.shape + (1,) * (values.ndim - 2))
    above = jnp.sum(weight * values, axis=1)
    mean = jnp.sum(above, axis=0)
    replicates = shares.shape[0]
    below = jnp.sum(weight, axis=1)
    apart = above - mean[None] * below  # in units of 1 / replicates
    return mean, jnp.sqrt(jnp.sum(apart**2, axis=0) * replicates / (replicates - 1))


# --- the box and its tilting


def _ordered_box(covariance, lower, upper, noise, answered):
    """Interval after interval the least probable one, given the expected values of those before it."""
    n = covariance.shape[0]
    both = answered[:, None] & answered[None, :]
    matrix = jnp.where(both, covariance, 0.0) + jnp.diag(jnp.where(answered, noise**2, 1.0))
    lower, upper = jnp.where(answered, lower, -jnp.inf), jnp.where(answered, upper, jnp.inf)

    def next_variable(k, state):
        columns, values, order, placed = state
        spread = jnp.sqrt(jnp.diagonal(matrix) - jnp.sum(columns**2, axis=1))
        shift = columns @ values
        edges = (lower - shift) / spread, (upper - shift) / spread
        log_mass, mean, _ = _intervals(jnp.zeros_like(shift), *edges, answered)
        row = jnp.argmin(jnp.where(placed, 2.0, jnp.where(answered, log_mass, 1.0))).astype(order.dtype)
        column = (matrix[:, row] - columns @ columns[row]) / spread[row]
        column = jnp.where(placed, 0.0, column).at[row].set(spread[row])
        return (columns.at[:, k].set(column), values.at[k].set(mean[row]), order.at[k].set(row),
                placed.at[row].set(True))  # fmt: skip

    state = jnp.zeros_like(matrix), jnp.zeros_like(lower), jnp.zeros(n, jnp.int32), jnp.zeros(n, bool)
    order = jax.lax.fori_loop(0, n, next_variable, state)[2]
    root = cholesky(matrix[order][:, order])
    diagonal = jnp.diagonal(root)
    half = solve_lower(root, jnp.eye(n, dtype=root.dtype))
    known = answered[order]
    half = jnp.zeros_like(half).at[:, order].set(jnp.where(known[:, None], half, 0.0))
    below = jnp.tril(root / diagonal[:, None], -1)
    return _Box(lower[order] / diagonal, upper[order] / diagonal, below, half, known)


def _intervals(mean, lower, upper, answered):
    """`confined_normal` of every variable; where there is no answer there is no interval, and all is 0."""
    lower = jnp.where(answered, lower, 0.0)
    parts = jax.vmap(confined_normal)(mean, lower, jnp.where(answered, upper, jnp.inf))
    return tuple(jnp.where(answered, part, 0.0) for part in parts)


class _Saddle(eqx.Module):
    x: Float[Array, " n"]
    mu: Float[Array, " n"]
    step: tuple[Float[Array, " n"], Float[Array, " n"]]
    scale: Float[Array, ""]
    size: Float[Array, ""]  # of the gradient
    psi: Float[Array, ""]
    count: Int[Array, ""]


def _tilting(box, max_steps=100):
    """The saddle point of psi by Newton's method: along its direction the gradient's length falls."""
    zero = jnp.zeros_like(box.lower)
    infinite = jnp.full((), jnp.inf, zero.dtype)
    begin = _Saddle(zero, zero, (zero, zero), jnp.ones_like(infinite), infinite, infinite, jnp.zeros((), jnp.int32))
    small = jnp.finfo(zero.dtype).eps ** 0.5

    def unfinished(state):
        return (state.count < max_steps) & (state.size > small) & (state.scale > 1e-8)

    def advance(state):
        trial = _saddle(box, *(at + state.scale * by for at, by in zip((state.x, state.mu), state.step, strict=True)))
        better = trial.size <= (1.0 - 1e-4 * state.scale) * state.size
        refused = eqx.tree_at(lambda s: s.scale, state, 0.5 * state.scale)
        taken = jax.tree.map(lambda new, old: jnp.where(better, new, old), trial, refused)
        return eqx.tree_at(lambda s: s.count, taken, state.count + 1)

    end = jax.lax.while_loop(unfinished, advance, begin)
    return _Tilt(end.mu, end.psi, end.size, end.count)


def _saddle(box, x, mu):
    """psi, the length of its gradient and Newton's direction at a point; a and b are its gradients in x and in mu."""
    shift = box.below @ x + mu
    log_mass, mean, curvature = _intervals(shift, box.lower, box.upper, box.answered)
    a, b = box.below.T @ mean - mu, mu - x + mean
    eye = jnp.eye(x.shape[0], dtype=x.dtype)
    bent = curvature[:, None] * box.below
    matrix = jnp.block([[-box.below.T @ bent, -eye - bent.T], [-eye - bent, jnp.diag(1.0 - curvature)]])
    step = -_solve(matrix, jnp.concatenate([a, b]))
    psi = jnp.sum(0.5 * mu**2 - mu * x + log_mass)
    size = jnp.sqrt(a @ a + b @ b)
    return _Saddle(x, mu, (step[: len(x)], step[len(x) :]), jnp.ones_like(psi), size, psi, jnp.zeros((), jnp.int32))


@_one_at_a_time
def _solve(matrix: Float[Array, "n n"], right: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.linalg.solve(matrix, right)


# --- sampling


def _propose(box, mu, uniform):
    """x (n, N) from the tilted sequence of confined normals, and psi (N,), from uniform numbers (n, N)."""
    n, count = uniform.shape

    def one(state, k):
        x, psi = state
        shift = box.below[k] @ x + mu[k]
        value, log_mass = _confined(uniform[k], box.lower[k] - shift, box.upper[k] - shift)
        value = value + mu[k]
        return (x.at[k].set(value), psi + 0.5 * mu[k] ** 2 - mu[k] * value + log_mass), None

    start = jnp.zeros((n, count), uniform.dtype), jnp.zeros(count, uniform.dtype)
    return jax.lax.scan(one, start, jnp.arange(n))[0]


def _confined(uniform, lower, upper):
    """Quantile of a standard normal confined to (lower, upper), and log of the mass of that interval.

    Reflected so that lower + upper >= 0. With Q the upper tail and R = Q(high) / Q(low), the quantile t has
    Q(t) = Q(low) (1 - u (1 - R)): by the inverse normal distribution near the centre, by Newton's method in log Q
    (three steps from a Rayleigh quantile) beyond 3.
    """
    mirrored = lower + upper < 0
    low, high = jnp.where(mirrored, -upper, lower), jnp.where(mirrored, -lower, upper)
    uniform = jnp.where(mirrored, 1.0 - uniform, uniform)
    far = low > 3.0
    bounded = ~jnp.isinf(high)
    near_low = jnp.where(far, 0.0, low)
    tail = 0.5 * jax.lax.erfc(near_low * 0.5**0.5)
    near_share = 1.0 - 0.5 * jax.lax.erfc(jnp.where(far, 1.0, high) * 0.5**0.5) / tail
    near = -jax.scipy.special.ndtri(tail * (1.0 - uniform * near_share))

    low_, high_ = jnp.where(far, low, 4.0), jnp.where(far & bounded, high, 5.0)
    hazard, hazard_high = low_ + excess_hazard(low_), high_ + excess_hazard(high_)
    ratio = jnp.exp(-0.5 * (high_ - low_) * (high_ + low_)) * hazard / hazard_high
    far_share = jnp.where(bounded, 1.0 - ratio, 1.0)
    fallen = -jnp.log1p(-uniform * far_share)  # log Q(low) - log Q(t)
    t = jnp.sqrt(low_**2 + 2.0 * fallen)
    for _ in range(3):
        at = t + excess_hazard(t)
        t = t - (fallen - 0.5 * (t - low_) * (t + low_) - jnp.log(at / hazard)) / -at
    value = jnp.where(far, t, near)
    log_near = jnp.log(tail * near_share)
    log_far = -0.5 * low_**2 - HALF_LOG_2PI - jnp.log(hazard) + jnp.log(far_share)
    return jnp.where(mirrored, -value, value), jnp.where(far, log_far, log_near)


def _accepted(key, box, tilt, count):
    """`count` independent draws of x (count, n); proposals are taken with probability exp(psi - psi*)."""
    n, batch = box.lower.shape[0], 2 * count
    found = tilt.gradient <= 1e-3

    def more(state):
        _, _, filled, rounds = state
        return (filled < count) & (rounds < 1000) & found

    def propose(state):
        key, kept, filled, rounds = state
        key, first, second = jax.random.split(key, 3)
        tiny = jnp.finfo(kept.dtype).tiny
        x, psi = _propose(box, tilt.mu, jax.random.uniform(first, (n, batch), kept.dtype, minval=tiny))
        taken = jnp.log(jax.random.uniform(second, (batch,), kept.dtype, minval=tiny)) < psi - tilt.highest
        place = jnp.where(taken, filled + jnp.cumsum(taken) - 1, count)
        x = jnp.where(box.answered[:, None], x, 0.0)
        return key, kept.at[place].set(x.T, mode="drop"), filled + jnp.sum(taken, dtype=filled.dtype), rounds + 1

    nothing = jnp.full((count, n), jnp.nan, box.lower.dtype)
    begin = key, nothing, jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(more, propose, begin)[1]


def _sobol(key, count, dim, dtype):
    """Independent scrambles (R, count, dim) of the first points of Sobol's sequence, in (0, 1).

    A random lower triangular matrix of bits times the generators of each dimension, and a random shift: every point is
    uniform, and the points of a scramble fill the cube as evenly as the sequence does.
    """
    bits = min(30, jnp.finfo(dtype).nmant)
    generators = jnp.asarray(_generators(count, dim, bits))  # (levels, dim)
    index = jnp.arange(count, dtype=jnp.uint32)

    def scrambled(key, columns):
        matrix, shift = jax.random.split(key)
        row = jnp.arange(bits, dtype=jnp.uint32)
        one = jnp.uint32(1) << row  # each row's own bit
        above = (jnp.uint32(1) << jnp.uint32(bits)) - (one << jnp.uint32(1))
        rows = (jax.random.bits(matrix, (bits,), jnp.uint32) & above) | one
        parity = jax.lax.population_count(rows[:, None] & columns[None, :]) & jnp.uint32(1)
        mixed = jnp.sum(parity << row[:, None], axis=0, dtype=jnp.uint32)
        point = jnp.full((count,), jax.random.bits(shift, (), jnp.uint32) >> jnp.uint32(32 - bits))
        for level in range(columns.shape[0]):
            point = point ^ jnp.where((index >> jnp.uint32(level)) & jnp.uint32(1) == 1, mixed[level], jnp.uint32(0))
        return (point.astype(dtype) + 0.5) * 2.0**-bits

    def replicate(key):
        return jax.vmap(lambda j, columns: scrambled(jax.random.fold_in(key, j), columns))(
            jnp.arange(dim), generators.T
        )

    points = jax.vmap(replicate)(jax.random.split(key, _REPLICATES))
    return jnp.moveaxis(points, 1, 2)


@functools.cache
def _generators(count: int, dim: int, bits: int) -> np.ndarray:
    """Sobol's generators (levels, dim) as integers, read from the sequence, which SciPy lists in Gray's order."""
    from scipy.stats import qmc  # imported late: slow, and only this method needs it

    levels = count.bit_length() - 1
    if 2**levels != count or count < 2:
        raise InputError(f"exact: {count * _REPLICATES} samples; give {_REPLICATES} times a power of 2.")
    points = qmc.Sobol(dim, scramble=False, bits=30).random(count)
    numbers = (points * 2.0**30).astype(np.uint32) >> np.uint32(30 - bits)
    generators = np.empty((levels, dim), np.uint32)
    generators[0] = numbers[1]
    for level in range(1, levels):
        generators[level] = numbers[2**level] ^ generators[level - 1]
    return generators
