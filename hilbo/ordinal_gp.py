"""Gaussian process with an ordinal likelihood: the model of one participant, and its posterior given the responses.

    gp        = OrdinalGP(kernel=RBF(theta=30.0, variance=1.0), likelihood=OrdinalProbit((-0.5, 0.5), noise=0.5))
    trials    = Trials.from_arrays(x, q)
    posterior = fit(gp, trials)
    mean, variance = posterior.predict(x_new)

Everything is a pytree: `jax.vmap(fit)` over stacked trials fits all participants, `jax.grad` through `fit` is exact.
Reference: paper, section IV.
"""

import functools
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Float, PRNGKeyArray

from hilbo.errors import InputError
from hilbo.fitting_input import check_answers, check_shapes, remark_outside
from hilbo.gaussian import Certificate, GaussianPosterior, Matrix, Scalar, Vector, mean_and_explained, shortfall
from hilbo.inference.ep import ep
from hilbo.inference.ep_corrected import ep_corrected
from hilbo.inference.exact import ExactPosterior, SamplingCertificate, exact
from hilbo.kernels import RBF, gram
from hilbo.laplace import laplace
from hilbo.likelihoods import OrdinalProbit, OrdinalTerms, TiltedTerms
from hilbo.numerics.shown import concrete, floats, has_values, numbers, shown
from hilbo.trials import Trials

__all__ = ["RBF", "InferenceError", "OrdinalGP", "OrdinalProbit", "Posterior", "Trials", "fit"]


def __dir__() -> list[str]:
    return __all__


_SOUGHT = {
    "laplace": "Laplace mode",
    "ep": "fixed point of expectation propagation",
    "ep_corrected": "fixed point of expectation propagation, corrected,",
    "exact": "exact posterior",
}
_PointsLike = ArrayLike | Sequence[Sequence[float]]
_CACHED, _PARTS = 2**16, 8  # covariances in memory when many points are predicted, and largest number of parts


class InferenceError(RuntimeError):
    """A fit did not converge; the message states which diagnostic failed and possible remedies."""


class OrdinalGP(eqx.Module):
    """Zero-mean Gaussian process prior on the latent function f and an ordinal likelihood of the responses."""

    kernel: Any
    """A `Kernel`: one of `hilbo.kernels` or a custom one; maximum evidence and sessions support the RBF only."""
    likelihood: OrdinalProbit

    def __check_init__(self) -> None:
        if isinstance(self.kernel, OrdinalProbit) or isinstance(self.likelihood, RBF):
            raise InputError("OrdinalGP: kernel and likelihood are exchanged; give the kernel first, or both by name.")

    def __repr__(self) -> str:
        return f"OrdinalGP({self.kernel!r}, {self.likelihood!r})"


class Posterior(eqx.Module):
    """Posterior of the latent function of one participant; the result of [`fit`][].

    `gp` and `trials` are those of the fit; `latent` is the posterior of the latent values at the tested points. Under
    `vmap` the arrays have a leading axis of participants; the methods are for one.
    """

    gp: OrdinalGP
    trials: Trials
    latent: GaussianPosterior | ExactPosterior

    @property
    def log_evidence(self) -> Scalar:
        """Log marginal likelihood log p(responses), approximate or sampled. A scalar, in nats."""
        return self.latent.log_evidence

    @property
    def certificate(self) -> Certificate | SamplingCertificate:
        """Convergence diagnostics of this fit; Monte Carlo standard errors if it is sampled."""
        return self.latent.certificate

    def mean(self, x: _PointsLike) -> Float[Array, " m"]:
        """Posterior mean (m,) of f at points (m, d) of the unit cube, without computing the variance.

        Raises `InputError` for points of another shape or not finite; warns of points outside the cube.
        """
        return _mean(self, self._points(x))

    def predict(self, x: _PointsLike) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Posterior mean and variance of f, (m,) each, at points (m, d) of the unit cube.

        Raises `InputError` for points of another shape or not finite; warns of points outside the cube.
        """
        return _predict(self, self._points(x))

    def predict_explained(self, x: _PointsLike) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
        """Posterior mean (m,) of f, and the explained variance (m,): prior minus posterior variance, without
        cancellation.

        `x`: points (m, d) of the unit cube. Raises `InputError` for another shape or values that are not finite; warns
        of points outside the cube.
        """
        return _mean_and_explained(self, self._points(x))

    def astype(self, dtype: DTypeLike) -> "Posterior":
        """Copy with all floating-point arrays converted to another float dtype.

        Screening many points in float32 costs half as much, with an error of about 1e-6 of the prior's standard
        deviation.
        """
        return jax.tree.map(lambda a: a.astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, self)

    def class_probabilities(self, x: _PointsLike) -> Float[Array, "m categories"]:
        """Predicted probabilities (m, C) of the response categories at points (m, d) of the unit cube.

        From mean and variance, assuming a normal f; after `inference="exact"` from the samples themselves. Raises
        `InputError` for points of another shape or not finite.
        """
        if isinstance(self.latent, ExactPosterior):
            return _sampled_probabilities(self, self._points(x))[0]
        mean, variance = self.predict(x)
        return jax.vmap(self.gp.likelihood.class_probabilities)(mean, variance)

    def predict_proba(self, x: _PointsLike) -> Float[Array, "m categories"]:
        """`class_probabilities` under the name that scikit-learn has for it."""
        return self.class_probabilities(x)

    def standard_errors(
        self, x: _PointsLike
    ) -> tuple[Float[Array, " m"], Float[Array, " m"], Float[Array, "m categories"]]:
        """Monte Carlo standard errors of mean (m,), variance (m,) and class probabilities (m, C) at points (m, d),
        after `inference="exact"`.

        Raises `InputError` for a posterior of another inference, and for points of another shape or not finite.
        """
        latent, x = _sampled(self, "standard_errors"), self._points(x)
        mean, variance = latent.moment_errors(gram(self.gp.kernel, self.trials.x, x))
        return mean, variance, _sampled_probabilities(self, x)[1]

    def draw(self, key: PRNGKeyArray, x: _PointsLike, count: int) -> Float[Array, "count m"]:
        """Independent draws (count, m) of the latent function from the exact posterior, jointly at all points (m, d).

        All NaN if the search for the tilting of the sampler did not converge. Raises `InputError` for a posterior of
        another inference, and for points of another shape or not finite.
        """
        return _draw(self, key, self._points(x), count)

    def _points(self, x: _PointsLike) -> Float[Array, "m d"]:
        """Points (m, d) as an array: floating-point JAX arrays keep their dtype, others take that of the trials.

        Raises `InputError` for another shape, for values that are not finite, and for a posterior of several
        participants; warns of points outside the unit cube. Traced values are not checked.
        """
        dtype = self.trials.x.dtype
        points = floats(x, dtype) if isinstance(x, jax.Array) else numbers("Posterior", "x", x, dtype)
        if self.trials.x.ndim != 2:
            raise InputError("Posterior: several participants; predict for each of them by jax.vmap.")
        if points.ndim != 2 or points.shape[1] != self.trials.x.shape[1]:
            dim = self.trials.x.shape[1]
            raise InputError(f"Posterior: x has shape {points.shape}; give points of shape (m, {dim}).")
        if concrete(points) and not np.all(np.isfinite(points)):
            row = int(np.argwhere(~np.isfinite(points))[0, 0])
            raise InputError(f"Posterior: x[{row}] has a value that is not finite; give points of the unit cube.")
        if concrete(points):
            remark_outside("Posterior", self.gp.kernel, np.asarray(points))
        return points

    def __repr__(self) -> str:
        """One line: numbers of participants (if stacked), responses and parameters, evidence of one participant, and
        whether certified; the fields of a traced posterior."""
        mask = self.trials.mask
        if not has_values(self.trials.x, mask) or not concrete(self) or mask.ndim > 2:
            return eqx.tree_pformat(self)
        if mask.ndim == 2:
            sure = np.asarray(self.latent.certificate.converged)
            certified = "all certified" if sure.all() else f"{int(sure.sum())} certified"
            answers, dim = int(mask.sum()), self.trials.x.shape[-1]
            return f"Posterior({len(mask)} people, {answers} answers, {dim} parameters, {certified})"
        sure = "certified" if self.certificate.converged else "NOT certified"
        answers, dim = int(mask.sum()), self.trials.x.shape[1]
        return f"Posterior({answers} answers, {dim} parameters, log evidence {shown(self.log_evidence)}, {sure})"


@functools.partial(jax.jit, static_argnames="count")
def _draw(posterior: Posterior, key: PRNGKeyArray, x: Float[Array, "m d"], count: int) -> Float[Array, "{count} m"]:
    """Compiled part of `Posterior.draw`: draws (count, m). Raises `InputError` for a posterior that is not sampled."""
    kernel, latent = posterior.gp.kernel, _sampled(posterior, "draw")
    return latent.draw(key, gram(kernel, posterior.trials.x, x), gram(kernel, x, x), count)


def _sampled(posterior: Posterior, wanted: str) -> ExactPosterior:
    """Return `posterior.latent` if it is sampled, else raise `InputError`; `wanted`: the calling method, for the
    message.
    """
    if not isinstance(posterior.latent, ExactPosterior):
        raise InputError(f'Posterior.{wanted}: this posterior is not sampled; fit with inference="exact".')
    return posterior.latent


@jax.jit
def _sampled_probabilities(
    posterior: Posterior, x: Float[Array, "m d"]
) -> tuple[Float[Array, "m categories"], Float[Array, "m categories"]]:
    """Class probabilities (m, C) and their standard errors (m, C), one point after the other.

    Raises `InputError` for a posterior that is not sampled.
    """
    latent = _sampled(posterior, "class_probabilities")

    def one(point):
        cross = gram(posterior.gp.kernel, posterior.trials.x, point[None, :])[:, 0]
        probabilities = posterior.gp.likelihood.class_probabilities
        return latent.expectation(probabilities, cross, posterior.gp.kernel.diagonal(point))

    return jax.lax.map(one, x)


@jax.jit
def _mean(posterior: Posterior, x: Float[Array, "m d"]) -> Float[Array, " m"]:
    """Compiled part of `Posterior.mean`: posterior mean (m,)."""
    return gram(posterior.gp.kernel, x, posterior.trials.x) @ posterior.latent.weights


@jax.jit
def _predict(posterior: Posterior, x: Float[Array, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Compiled part of `Posterior.predict`: posterior mean and variance, (m,) each."""
    mean, explained = _mean_and_explained(posterior, x)
    return mean, jax.vmap(posterior.gp.kernel.diagonal)(x) - explained


@jax.jit
def _mean_and_explained(posterior: Posterior, x: Float[Array, "m d"]) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Posterior mean and explained variance, (m,) each, computed in at most 8 parts of the points."""
    latent, count = posterior.latent, x.shape[0]
    # Parts keep the covariances in a core's cache; a scan would drop derivative rules. The transposition makes each
    # coordinate contiguous, for vectorised loops over points.
    x = jax.lax.optimization_barrier(x.T).T
    size = max(_CACHED // max(posterior.trials.capacity, 1), -(-count // _PARTS), 1)
    parts = [
        mean_and_explained(
            latent.weights,
            latent.factor,
            latent.inverse,
            gram(posterior.gp.kernel, posterior.trials.x, x[first : first + size]),
        )
        for first in range(0, max(count, 1), size)
    ]
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *pieces: jnp.concatenate(pieces), *parts)


def fit(
    gp: OrdinalGP, trials: Trials, *, inference: str = "laplace", start: Vector | None = None, throw: bool = True
) -> Posterior:
    """Posterior of the latent function given the responses.

    **Arguments:**

    - `gp`: the model.
    - `trials`: the responses; empty trials give the prior.
    - `inference`: "laplace" (paper, section IV-1); "ep", expectation propagation, with a far smaller error;
      "ep_corrected", ten times more accurate still at slightly more cost; or "exact", sampled, for up to about 100
      responses and without derivatives (docs/methods/inference.md). The samples are the same in every fit.
    - `start`: `posterior.latent.weights` of a fit to nearly the same trials, to save Newton steps.
    - `throw`: raise `InferenceError` if the fit has not converged. Use `False` under `vmap`, and check
      `posterior.certificate.converged`.

    **Returns:** a [`Posterior`][], differentiable in every array of `gp`. Raises `InputError` for arguments that do not
    match.
    """
    if not isinstance(gp, OrdinalGP) or not isinstance(trials, Trials):
        given = f"{type(gp).__name__} and {type(trials).__name__}"
        raise InputError(f"fit: takes an OrdinalGP and Trials, not {given}; write fit(gp, Trials.from_arrays(x, q)).")
    if inference not in _SOUGHT:
        raise InputError(f'fit: inference is "{inference}"; it must be one of {", ".join(_SOUGHT)}.')
    check_shapes(gp.kernel, gp.likelihood, trials, start)
    if inference == "exact" and concrete(trials):  # whose samples would take -1 for the last category
        check_answers(_without_padding(trials), gp.likelihood.categories)
    if concrete(trials):
        remark_outside("fit", gp.kernel, np.asarray(trials.x)[np.asarray(trials.mask)])
    posterior = _fit(gp, trials, start, inference)
    return _checked(posterior, _SOUGHT[inference]) if throw else posterior


def _without_padding(trials: Trials) -> Trials:
    """Copy of the trials with point and category of rows without a response set to 0; mask and context are kept.

    Padding may be NaN, and 0 times NaN is NaN, in values and in derivatives.
    """
    x = jnp.where(trials.mask[:, None], trials.x, 0)
    return Trials(x, jnp.where(trials.mask, trials.q, 0), trials.mask, trials.context)


@functools.partial(jax.jit, static_argnames="inference")
def _fit(gp: OrdinalGP, trials: Trials, start: Vector | None, inference: str) -> Posterior:
    """Compiled part of `fit`: the posterior by the given `inference`, converged or not; nothing is checked."""
    trials = _without_padding(trials)
    covariance = gram(gp.kernel, trials.x, trials.x)
    if inference in ("ep", "ep_corrected"):
        tilted = TiltedTerms(gp.likelihood, trials.q, trials.mask)
        return Posterior(gp, trials, (ep if inference == "ep" else ep_corrected)(covariance, tilted, start=start))
    if inference == "exact":
        return Posterior(gp, trials, _exact_latent(gp.likelihood, trials, covariance))
    terms = OrdinalTerms(gp.likelihood, trials.q, trials.mask)
    return Posterior(gp, trials, laplace(covariance, terms, start=start))


def _exact_latent(likelihood: OrdinalProbit, trials: Trials, covariance: Matrix) -> ExactPosterior:
    """Posterior of the latent values at the trials by sampling; `covariance` K (n, n). The random key is fixed, so that
    every fit has the same samples.
    """
    ends = jnp.full((1,), jnp.inf, covariance.dtype)
    edges = jnp.concatenate([-ends, likelihood.thresholds.astype(covariance.dtype), ends])
    noise = likelihood.noise.astype(covariance.dtype)
    return exact(jax.random.key(0), covariance, edges[trials.q], edges[trials.q + 1], noise, trials.mask)


def _checked(posterior: Posterior, sought: str) -> Posterior:
    """Return the posterior if it has converged, else raise `InferenceError` (under `jit` an equinox error).

    A point that is not finite, or a response outside the categories, raises `InputError` instead. `sought`: what was
    searched for, for the message.
    """
    certificate = posterior.certificate
    if isinstance(certificate.converged, jax.core.Tracer):
        message = f"the {sought} was not found to its tolerance; fit with throw=False and read the certificate"
        return eqx.error_if(posterior, ~certificate.converged, message)
    if not bool(certificate.converged):
        check_answers(posterior.trials, posterior.gp.likelihood.categories)
        words = shortfall(certificate, posterior.log_evidence)
        raise InferenceError(f"the {sought} was {words}, or throw=False to look at the certificate.")
    return posterior
