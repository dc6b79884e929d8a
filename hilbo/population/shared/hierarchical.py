"""The share of the prior variance that participants have in common, and the model with the participant as a coordinate.

    f_j = g + h_j,   cov(g) = p k,   cov(h_j) = (1 - p) k,   so   cov(f_i(x), f_j(y)) = k(x, y) (p + (1 - p) [i = j])

The share p is learnt by evidence: p = 1 means that participants do not differ (the pooled model, and the committee
machine's assumption), p = 0 that one participant's responses carry no information about another.

The model is an ordinal GP like any other, with the participant's number as one more coordinate of each point, so that
fit, evidence and certificate are those of `ordinal_gp`, at a cost that is cubic in the number of responses. Where they
are at few points, Laplace's evidence and posterior of g are those of `low_rank` with all points as pivots, which is the
same at a cost that is linear in participants; elsewhere it would be several times as slow.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike, DTypeLike
from jaxtyping import Array, Bool, Float

from hilbo.errors import InputError
from hilbo.kernels import Kernel
from hilbo.numerics.host import to_device
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import OrdinalGP, Posterior, Trials, fit
from hilbo.population.shared.features import Pivots, every_point
from hilbo.population.shared.low_rank import SharedEvidence, shared_evidence
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.tallies import Tallies, tallied

__all__ = [
    "PersonKernel",
    "Share",
    "few_points",
    "fit_people",
    "learn_share",
    "of_people",
    "share_from",
    "shared_posterior",
]

Evidence = Callable[[Float[Array, ""]], tuple[Any, Any]]
"""Of a share: the log evidence there, and whether its fit converged."""

_NODES = 33  # of the log evidence's Chebyshev interpolation in p
_ENOUGH, _USABLE = 1e-5, 0.02  # error of the log evidence between them: that ends the refinement, that is too large
_FINE = 2001


class PersonKernel(eqx.Module):
    """Covariance of participants' functions at points (x, participant): `kernel` within one, `share` of it between
    two.
    """

    kernel: Kernel
    share: Float[Array, ""]

    def __init__(self, kernel: Kernel, share: ArrayLike):
        self.kernel = kernel
        self.share = jnp.asarray(share, jnp.result_type(float) if isinstance(share, float | int) else None)

    def __call__(self, x: Float[Array, " d"], y: Float[Array, " d"]) -> Float[Array, ""]:
        """Covariance of the functions of participant x[-1] at x[:-1] and of participant y[-1] at y[:-1], a scalar.

        `x`, `y` (d,): a point and the participant's number.
        """
        same = x[-1] == y[-1]
        return self.kernel(x[:-1], y[:-1]) * jnp.where(same, jnp.ones_like(x[0]), self.share.astype(x.dtype))

    def diagonal(self, x: Float[Array, " d"]) -> Float[Array, ""]:
        """Prior variance of one participant's function. `x` (d,): a point and the participant's number -> a scalar."""
        return self.kernel.diagonal(x[:-1])


class Share(eqx.Module):
    """Posterior of the share p, with a uniform prior on [0, 1]: log evidence on a grid of `shares`, mode, mean and
    central 95 % interval; `converged` if all fits did and the interpolation is accurate.
    """

    shares: Float[Array, " k"]
    """Grid over [0, 1]."""
    log_evidence: Float[Array, " k"]
    """Of the answers, on that grid."""
    best: Float[Array, ""]
    """Where the evidence is largest."""
    mean: Float[Array, ""]
    interval: Float[Array, "2"]
    """Central 95 % of the posterior of p."""
    interpolation_error: Float[Array, ""]
    """Estimate, of the log evidence between the nodes: its last Chebyshev coefficients."""
    converged: Array
    """Every fit converged, and the interpolation reached its tolerance."""

    @property
    def against_one(self) -> Float[Array, ""]:
        """Log Bayes factor of the hierarchical model, p unknown, against people who do not differ, p = 1.

        A scalar, in nats.
        """
        shares, logs = np.asarray(self.shares), np.asarray(self.log_evidence)
        top = logs.max()
        return to_device(top + np.log(np.trapezoid(np.exp(logs - top), dx=shares[1] - shares[0])) - logs[-1])


def of_people(trials: Trials) -> Trials:
    """One table from stacked trials (M, n): all responses, each at its point with the participant's number, from 0, as
    a further coordinate.

    Contexts are dropped. Raises `InputError` without responses.
    """
    mask = np.asarray(trials.mask)
    if not mask.any():
        raise InputError("hierarchical: there are no responses; at least one participant's are needed.")
    person = np.broadcast_to(np.arange(len(mask))[:, None], mask.shape)[mask].astype(np.asarray(trials.x).dtype)
    return Trials.from_arrays(
        np.concatenate([np.asarray(trials.x)[mask], person[:, None]], axis=1), np.asarray(trials.q)[mask]
    )


def few_points(trials: Trials) -> bool:
    """Whether stacked trials (M, n) have at least three responses for each distinct point: then the low-rank model with
    all points as pivots costs less than one fit of all responses.
    """
    mask = np.asarray(trials.mask)
    return bool(3 * len(np.unique(np.asarray(trials.x)[mask], axis=0)) <= mask.sum())


def fit_people(
    gp: OrdinalGP, trials: Trials, share: ArrayLike, *, inference: str = "laplace", throw: bool = True
) -> Posterior:
    """Posterior of all participants' functions, from the trials of `of_people`.

    Predict at points (x, participant): a number from 0, or any other for a participant without responses. `share`: in
    [0, 1]; differentiable in it. `throw`: raise `InferenceError` if the fit has not converged.
    """
    model = OrdinalGP(PersonKernel(gp.kernel, share), gp.likelihood)
    return fit(model, trials, inference=inference, throw=throw)


def shared_posterior(posterior: Posterior) -> Posterior:
    """Posterior of g alone, from one of `fit_people` with a stationary kernel: a GP with p times the prior variance.

    The weights and C of the responses stay the same, since the covariance of g with every f_j is p k; the last
    coordinate of the points is dropped.
    """
    kernel, trials, latent = posterior.gp.kernel, posterior.trials, posterior.latent
    person = kernel.kernel
    of_shared = person.with_numbers(person.theta, kernel.share.astype(person.variance.dtype) * person.variance)
    return Posterior(
        OrdinalGP(of_shared, posterior.gp.likelihood), Trials(trials.x[:, :-1], trials.q, trials.mask), latent
    )


def learn_share(gp: OrdinalGP, trials: Trials, inference: str = "laplace") -> Share:
    """Posterior of the share p from stacked trials (M, n), by several fits; `gp` is one participant's model.

    Fits that do not converge do not raise: read `converged`. Not under `jit`.
    """
    if inference == "laplace" and few_points(trials):
        answers = tallied(trials, gp.likelihood.categories)
        return share_from(_by_features(gp, answers), trials.x.dtype)
    together = of_people(trials)
    return share_from(lambda share: _by_numbers(gp, together, share, inference), trials.x.dtype)


def _by_features(gp: OrdinalGP, answers: Tallies) -> Evidence:
    """Function that computes the log evidence of a share by `low_rank`, and whether the fit converged.

    It remembers its fits: the mode is searched from an extrapolation of those at the three nearest shares.
    """
    pivots = every_point(PeopleModel.of(gp, 1.0, 0).unit, answers)
    known: dict[float, Float[np.ndarray, "M n"]] = {}

    def evidence(share: Float[Array, ""]) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        p = float(share)
        near = sorted(known, key=lambda other: abs(other - p))[:3]
        parts = {s: math.prod((p - other) / (s - other) for other in near if other != s) for s in near}
        start = sum((part * known[s] for s, part in parts.items()), answers.blank)
        end = _shared_evidence(gp, answers, share, to_device(start), pivots)
        known[p] = np.asarray(end.weights)
        return end.value, end.arrived

    return evidence


@program
def _shared_evidence(
    gp: OrdinalGP, answers: Tallies, share: Float[Array, ""], start: Float[Array, "M n"], pivots: Pivots
) -> SharedEvidence:
    """`shared_evidence` of the model with this share; `start` (M, n): weights near the mode."""
    return shared_evidence(PeopleModel.of(gp, share, len(start)), answers, start, pivots)


@program
def _by_numbers(
    gp: OrdinalGP, trials: Trials, share: Float[Array, ""], inference: str
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Log evidence of one share, from the trials of `of_people`, and whether the fit converged; scalars."""
    posterior = fit_people(gp, trials, share, inference=inference, throw=False)
    return posterior.log_evidence, posterior.certificate.converged


def share_from(evidence: Evidence, dtype: DTypeLike) -> Share:
    """Posterior of the share from its log evidence: `evidence` takes a share, a scalar, and returns the log evidence in
    nats and whether the fit converged.

    It is called at Chebyshev points of [0, 1], 9, 17 or 33 of them, until the interpolation is accurate. Not under
    `jit`.
    """
    evaluated: dict[int, tuple[float, bool]] = {}  # by place among the finest nodes, in which the coarser ones are
    for step in (4, 2, 1):
        for node in (i for i in range(0, _NODES, step) if i not in evaluated):
            value, held = evidence(to_device((1 + _nodes()[node]) / 2, dtype))
            evaluated[node] = float(value), bool(held)
        every = sorted(evaluated)
        fitted = np.array([evaluated[i][0] for i in every])
        coefficients = np.polynomial.chebyshev.chebfit(_nodes()[every], fitted, len(every) - 1)
        error = np.abs(coefficients[-2:]).sum()
        if error < _ENOUGH:
            break
    grid = np.linspace(0.0, 1.0, _FINE)
    curve = np.polynomial.chebyshev.chebval(2 * grid - 1, coefficients)
    weight = np.exp(curve - curve.max())
    area = np.concatenate([[0.0], np.cumsum((weight[1:] + weight[:-1]) / 2)])
    return Share(
        shares=to_device(grid),
        log_evidence=to_device(curve),
        best=to_device(grid[curve.argmax()]),
        mean=to_device(np.trapezoid(weight * grid) / np.trapezoid(weight)),
        interval=to_device(np.interp([0.025, 0.975], area / area[-1], grid)),
        interpolation_error=to_device(error),
        converged=to_device(error < _USABLE and all(good for _, good in evaluated.values())),
    )


def _nodes() -> np.ndarray:
    """The 33 Chebyshev points of [-1, 1], rising."""
    return -np.cos(np.pi * np.arange(_NODES) / (_NODES - 1))
