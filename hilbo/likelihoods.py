"""Ordinal probit likelihood: log p(q | f), its derivatives and class probabilities, exact in both tails.

A response in category j means that y = f + noise * e, e ~ N(0, 1), lies between two thresholds (paper, section IV-1):

    p(q = j | f) = Phi(b) - Phi(a),   a = (t_{j-1} - f) / noise,   b = (t_j - f) / noise.

z = (y - f) / noise is then a standard normal truncated to (a, b), and log p and all its derivatives are functions of
that normal's mass and cumulants (`hilbo.numerics.truncated_normal`). Inference receives the responses as terms, one for
each row of a table of trials: `OrdinalTerms` at latent values, `TiltedTerms` averaged over normals. Reference: Chu &
Ghahramani (2005), JMLR 6:1019.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

from hilbo.errors import InputError
from hilbo.numerics.shown import check_positive, concrete, float_dtype, floats, numbers, shown
from hilbo.numerics.tracing import traced_once
from hilbo.numerics.truncated_normal import truncated_normal

__all__ = ["Goal", "OrdinalProbit", "OrdinalTerms", "TiltedTerms"]


def __dir__() -> list[str]:
    return __all__


def _rising(thresholds: np.ndarray) -> bool:
    """Whether there is at least one threshold, and all are finite and increasing along the last axis, of all
    participants.
    """
    not_empty = thresholds.ndim > 0 and thresholds.shape[-1] > 0
    return bool(not_empty and np.all(np.isfinite(thresholds)) and np.all(np.diff(thresholds) > 0))


class OrdinalProbit(eqx.Module):
    """Ordinal probit likelihood with C = len(thresholds) + 1 categories, lowest first.

    **Arguments:**

    - `thresholds`: increasing numbers (C - 1,), in units of the latent f; the outermost categories are unbounded.
    - `noise`: standard deviation c_o > 0 of the classification noise, in units of f.

    Raises `InputError` for thresholds that do not increase and a noise that is not above 0. Traced values are not
    checked; invalid ones give NaN.
    """

    thresholds: Float[Array, " edges"]
    noise: Float[Array, ""]

    def __init__(self, thresholds: ArrayLike | Sequence[float | int], noise: ArrayLike):
        self.thresholds = numbers("OrdinalProbit", "thresholds", thresholds, float_dtype(thresholds))
        self.noise = numbers("OrdinalProbit", "noise", noise, self.thresholds.dtype)
        check_positive("OrdinalProbit", noise=self.noise)
        if concrete(self.thresholds) and not _rising(np.asarray(self.thresholds)):
            given = shown(self.thresholds)
            raise InputError(f"OrdinalProbit: thresholds is {given}; it must be a list of finite numbers that rise.")

    def __repr__(self) -> str:
        return f"OrdinalProbit(thresholds={shown(self.thresholds)}, noise={shown(self.noise)})"

    @property
    def categories(self) -> int:
        """Number C of categories: one more than thresholds."""
        return self.thresholds.shape[-1] + 1

    def log_prob(self, f: ArrayLike, q: ArrayLike) -> Float[Array, ""]:
        """log p(q | f) for one latent value `f` and one category `q` in 0..C-1.

        Differentiable to any order in `f`, the thresholds and the noise; exact in both tails. Both are scalars, and so
        is the result; `jax.vmap` for several. NaN for a category below 0.
        """
        f, lower, upper, noise = self._edges(f, q)
        return truncated_normal(f, lower, upper, noise).log_mass

    def expand(self, f: ArrayLike, q: ArrayLike) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """log p(q | f), its derivative in `f`, and minus its second derivative (in [0, 1 / noise^2]).

        `f`, the category `q` in 0..C-1 and all results are scalars; `jax.vmap` for several. NaN for a category below 0.
        """
        f, lower, upper, noise = self._edges(f, q)
        truncated = truncated_normal(f, lower, upper, noise)
        return truncated.log_mass, truncated.mean / noise, truncated.curvature / noise**2

    def smoothed(
        self, mean: ArrayLike, variance: ArrayLike, q: ArrayLike
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """Log of the integral of p(q | f) over f ~ N(mean, variance), its derivative in `mean`, and site precision t.

        All arguments and results are scalars. t is the precision of the Gaussian site that gives that normal the
        variance of the tilted distribution. The integral is the same likelihood with its noise grown to s, s^2 =
        noise^2 + variance; minus the second derivative in `mean` is t / (1 + variance t). With k_2 the variance of the
        truncated normal, t = (1 - k_2) / (noise^2 + variance k_2): never negative, at most 1 / noise^2.
        """
        mean, lower, upper, noise = self._edges(mean, q)
        variance = jnp.asarray(variance, mean.dtype)
        spread = jnp.sqrt(noise**2 + variance)
        truncated = truncated_normal(mean, lower, upper, spread)
        precision = truncated.curvature / (noise**2 + variance * (1.0 - truncated.curvature))
        return truncated.log_mass, truncated.mean / spread, precision

    def class_probabilities(self, mean: ArrayLike, variance: ArrayLike = 0.0) -> Float[Array, " categories"]:
        """Probabilities (C,) of the categories when f ~ N(mean, variance); they sum to 1 within rounding.

        `mean` and `variance` are scalars. Paper, section VI: the noise grows to sqrt(noise^2 + variance), and the edges
        stay. NaN for a noise that is not above 0.
        """
        mean, variance = floats(jnp.asarray(mean), self.thresholds.dtype), jnp.asarray(variance)
        spread = jnp.sqrt(self.noise**2 + variance.astype(self.noise.dtype))
        blurred = OrdinalProbit(self.thresholds, jnp.where(self.noise > 0, spread, jnp.nan))
        return jnp.exp(jax.vmap(lambda q: blurred.log_prob(mean, q))(jnp.arange(self.categories)))

    def _edges(
        self, f: ArrayLike, q: ArrayLike
    ) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
        """`f`, the lower and upper edge of category `q` (infinite at the ends) and the noise: scalars in the dtype of
        `f`.

        For invalid thresholds or noise the returned noise is NaN, for a negative category the lower edge. Raises
        `InputError` for arguments that are not scalars.
        """
        if jnp.ndim(f) or jnp.ndim(q) or jnp.ndim(self.noise) or jnp.ndim(self.thresholds) != 1:
            shapes = f"{jnp.shape(f)}, {jnp.shape(q)}, {jnp.shape(self.thresholds)} and {jnp.shape(self.noise)}"
            raise InputError(
                f"OrdinalProbit: value, category, thresholds and noise have the shapes {shapes}; all but the thresholds"
                " are scalars, use jax.vmap for several."
            )
        dtype = self.thresholds.dtype
        latent = floats(jnp.asarray(f, dtype if isinstance(f, int | float) else None), dtype)
        ends = jnp.full((1,), jnp.inf, latent.dtype)
        edges = jnp.concatenate([-ends, self.thresholds.astype(latent.dtype), ends])
        rises = jnp.all(self.thresholds[1:] > self.thresholds[:-1])
        noise = jnp.where(rises & (self.noise > 0), self.noise, jnp.nan).astype(latent.dtype)
        lower = jnp.where(jnp.asarray(q) < 0, jnp.nan, edges[q])  # which an index below 0 would count from the end
        return latent, lower, edges[q + 1], noise


class OrdinalTerms(eqx.Module):
    """Responses as log-likelihood terms with slopes and curvatures.

    `q` (n,): categories; `mask` (n,): False in rows without a response, whose terms are 0.
    """

    likelihood: OrdinalProbit
    q: Int[Array, " n"]
    mask: Bool[Array, " n"]

    @traced_once
    def __call__(self, eta: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
        """log p(q_i | eta_i), its derivative, and minus its second derivative, at latent values `eta` (n,); (n,)
        each.
        """
        expansion = jax.vmap(self.likelihood.expand)(eta, self.q)
        value, slope, curvature = (jnp.where(self.mask, term, jnp.zeros_like(term)) for term in expansion)
        return value, slope, curvature


class TiltedTerms(eqx.Module):
    """Responses averaged over cavities, for expectation propagation: log integrals, slopes and site precisions.

    `q` (n,): categories; `mask` (n,): False in rows without a response, whose terms are 0.
    """

    likelihood: OrdinalProbit
    q: Int[Array, " n"]
    mask: Bool[Array, " n"]

    @traced_once
    def __call__(
        self, mean: Float[Array, " n"], variance: Float[Array, " n"]
    ) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
        """Log of the integral of p(q_i | f) over f ~ N(mean_i, variance_i), its derivative in the mean, and the site
        precision (`OrdinalProbit.smoothed`); (n,) each.
        """
        smoothed = jax.vmap(self.likelihood.smoothed)(mean, variance, self.q)
        value, slope, precision = (jnp.where(self.mask, term, jnp.zeros_like(term)) for term in smoothed)
        return value, slope, precision


class Goal(NamedTuple):
    """The response that a study searches for: index `category` (from 0) of `categories` responses.

    The probit likelihood makes a response between others likeliest in the middle of its two thresholds, and less likely
    the farther the latent value is from there, to both sides alike. With the closeness u to the goal,

        highest response:  u(f) = f
        lowest response:   u(f) = -f
        between:           u(f) = -|f - m|,   m the middle of the response's thresholds

    P(goal | f) rises with u(f) whatever the noise is.
    """

    category: int
    categories: int

    @classmethod
    def highest(cls, categories: int) -> "Goal":
        """The highest of `categories` responses."""
        return cls(categories - 1, categories)

    @classmethod
    def of(cls, responses: Sequence[str], label: str = "") -> "Goal":
        """The response with this label, one of `responses` (lowest first); without a label the highest."""
        return cls(responses.index(label), len(responses)) if label else cls.highest(len(responses))

    @property
    def is_highest(self) -> bool:
        """Whether the goal is the highest response."""
        return self.category == self.categories - 1

    @property
    def is_between(self) -> bool:
        """Whether responses both below and above the goal exist."""
        return 0 < self.category < self.categories - 1

    def sentence(self, label: str) -> str:
        """What the goal, with this label, means for the optimum: one sentence; empty for the highest response."""
        if self.is_highest:
            return ""
        if not self.is_between:
            return f'The goal is "{label}", the lowest response: the lower the latent score is, the better.'
        return (
            f'The goal is "{label}", between other responses: the nearer the latent score is to the middle of its two'
            " thresholds, the better."
        )

    def closeness(self, likelihood: OrdinalProbit, f: Float[Array, "*m"]) -> Float[Array, "*m"]:
        """Closeness u(f) of latent values to the goal, in their unit, of their shape and dtype."""
        if self.is_highest:
            return f
        if not self.is_between:
            return -f
        lower, upper = likelihood.thresholds[self.category - 1], likelihood.thresholds[self.category]
        return -jnp.abs(f - ((lower + upper) / 2).astype(f.dtype))
