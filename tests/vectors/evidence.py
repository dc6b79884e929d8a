"""What the closed expansions of the evidence are held against: differentiation through the fit, and textbook loops."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from datasets import Dataset, hostile_cases, noisy
from helpers import answers, model
from jax.flatten_util import ravel_pytree
from reference_ep import textbook_ep
from reference_exact import gram
from reference_laplace import numpy_laplace

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.hyperparameters.coordinates import coordinates_of, model_at

__all__ = [
    "EVERY",
    "HASTY",
    "SCATTERED",
    "STEP",
    "make",
    "scattered_gp",
    "scattered_trials",
    "three",
    "through_the_fit",
]

EVERY = ("theta", "variance", "noise", "thresholds")
STEP = 1e-4
HASTY = (
    "noise=0.001 theta=0.01 variance=0.001 n=25 independent",
    "noise=0.01 theta=30 variance=10000 n=25 conflicting",
    "noise=0.001 theta=0.01 variance=0.001 n=200 independent",
    "noise=0.01 theta=30 variance=1 n=200 conflicting",
)
_RNG = np.random.default_rng(0)
SCATTERED = np.c_[10 ** _RNG.uniform(-4, 0, 200), 10 ** _RNG.uniform(-1, 5, 200), 10 ** _RNG.uniform(-1, 2, 200)]
"""(200, 3): noise, variance and theta of models from harmless to hopeless."""


def three() -> Dataset:
    """20 of the noisy answers in three categories, at one theta that matters."""
    data = noisy()
    return dataclasses.replace(
        data, name="three", x=data.x[:20], q=np.minimum(data.q[:20], 2), theta=5.0, thresholds=data.thresholds[:2]
    )


def through_the_fit(gp: OrdinalGP, trials: Trials, inference: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Evidence, gradient (p,) and Hessian (p, p) in the coordinates of every hyperparameter, by differentiation."""
    flat, restore = ravel_pytree(coordinates_of(gp, EVERY))

    def value_and_slope(at):
        value, slope = jax.value_and_grad(
            lambda at: fit(model_at(restore(at), gp), trials, inference=inference, throw=False).log_evidence
        )(at)
        return slope, (value, slope)

    hessian, (value, slope) = jax.jit(jax.jacfwd(value_and_slope, has_aux=True))(flat)
    return np.asarray(value), np.asarray(slope), np.asarray(hessian)


def _reference(inference):
    """The textbook's evidence around the model, STEP away in one coordinate after the other."""
    data = three()
    flat, restore = ravel_pytree(coordinates_of(model(data), EVERY))

    def at(place):
        gp = model_at(restore(place), model(data))
        theta, variance, noise = map(float, (gp.kernel.theta, gp.kernel.variance, gp.likelihood.noise))
        thresholds = np.asarray(gp.likelihood.thresholds)
        if inference == "laplace":
            return numpy_laplace(data.x, data.q, theta, variance, thresholds, noise, data.x)["log_evidence"]
        edges = np.concatenate([[-np.inf], thresholds, [np.inf]])
        return textbook_ep(gram(data.x, data.x, theta, variance), edges[data.q], edges[data.q + 1], noise)[2]

    steps = STEP * np.eye(flat.size)
    above, below = ([at(flat + sign * step) for step in steps] for sign in (1, -1))
    return {"middle": at(flat), "above": above, "below": below}


def scattered_trials(dtype) -> Trials:
    return answers(noisy(), dtype=np.dtype(dtype).type)


def scattered_gp(scattered, dtype) -> OrdinalGP:
    noise, variance, theta = scattered.astype(dtype)
    return OrdinalGP(RBF(theta, variance), OrdinalProbit(jnp.asarray(noisy().thresholds, dtype), noise))


def _scattered(inference):
    """Evidence in float64, and whether it is known."""
    trials = scattered_trials(jnp.float64)

    def one(scattered):
        fitted = fit(scattered_gp(scattered, jnp.float64), trials, inference=inference, throw=False)
        return fitted.log_evidence, fitted.certificate.converged

    value, known = jax.jit(lambda models: jax.lax.map(one, models))(jnp.asarray(SCATTERED))
    return {"value": np.where(known, value, 0.0), "known": known}


def _hasty(name):
    data = next(case for case in hostile_cases() if case.name == name)
    fitted = fit(model(data), answers(data, len(data.q)), inference="ep", throw=False)
    assert bool(fitted.certificate.converged)
    return fitted.log_evidence


def _expansion(inference):
    value, gradient, hessian = through_the_fit(model(three()), answers(three()), inference)
    return {"value": value, "gradient": gradient, "hessian": hessian, "reference": _reference(inference)}


def make() -> dict:
    both = ("laplace", "ep")
    expansions = {inference: _expansion(inference) for inference in both}
    return expansions | {
        "hasty": {name: _hasty(name) for name in HASTY},
        "scattered": {inference: _scattered(inference) for inference in both},
    }
