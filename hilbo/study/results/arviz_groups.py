"""A material's results for ArviZ: posterior, posterior predictive and observed responses as netCDF groups.

Groups and variables (dimensions chain, draw, participant, answer; of log_likelihood chain, draw, obs_id):

    posterior             f: latent score at each participant's trials, drawn from N(mode, K - K C K)
    posterior_predictive  response: predicted responses (categories from 0) at the same trials
    log_likelihood        response: log P(response | f) without padding, with participant and answer of each, since
                          `arviz.loo` counts every element as an observation
    observed_data         response: the responses, -1 in unused slots
    constant_data         one variable for each parameter, in its unit; thresholds and noise of the likelihood; trial
                          (and session) of each response, as in the trial table

`answer` counts each participant's fitted responses from 1. Voided, warm-up and repeated ones are not included, so that
it is not the trial number: rows of the table are identified by `trial` and `session`. `arviz.from_netcdf` and
`xarray.open_datatree` read the file. Each participant's posterior is separate, without pooling.
"""

import os
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Bool, Float, Int, Key

from hilbo.errors import InputError
from hilbo.kernels import gram
from hilbo.numerics.linalg import eigh
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.search.box import Parameter
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study

__all__ = ["groups", "inference_data", "predictive_shares", "write_groups"]

_DIMS = ("chain", "draw", "participant", "answer")


def groups(
    study: Study, cohort: Cohort, posteriors: Posterior, draws: int = 200, seed: int = 0
) -> dict[str, xr.Dataset]:
    """The groups as datasets, by name. `draws`: number of independent draws, as one chain, from `seed`. Unused slots
    are NaN, -1 or ""."""
    keys = jax.random.split(jax.random.key(seed), len(cohort.names))
    f, response, log_likelihood = (np.moveaxis(np.asarray(leaf), 0, 1)[None] for leaf in _draw(posteriors, keys, draws))
    mask = np.asarray(cohort.trials.mask)
    coords = {"participant": list(cohort.names), "answer": np.arange(1, mask.shape[1] + 1)}
    chains = coords | {"chain": [0], "draw": np.arange(draws)}
    held = mask[None, None]
    observed = np.where(mask, np.asarray(cohort.trials.q), -1)
    constants: dict[str, Any] = {
        p.name: (_DIMS[2:], np.where(mask, cohort.physical[..., i], np.nan), _attributes(p))
        for i, p in enumerate(study.space.parameters)
    }
    likelihood = jax.tree.map(lambda leaf: leaf[0], posteriors.gp).likelihood  # what a rule learnt, where it learns
    constants["thresholds"] = ("edge", np.asarray(likelihood.thresholds))
    constants["noise"] = ((), np.asarray(likelihood.noise))
    if cohort.numbers is not None:
        constants["trial"] = (_DIMS[2:], np.where(mask, cohort.numbers, -1), {"long_name": "trial of the table"})
    if cohort.session is not None:
        names_of = np.array(cohort.sessions, object)[cohort.session]
        constants["session"] = (_DIMS[2:], np.where(mask, names_of, ""))
    names = ", ".join(f"{k} = {label}" for k, label in enumerate(study.responses))
    say = {"long_name": "answer", "categories": names}
    return {
        "posterior": xr.Dataset({"f": (_DIMS, np.where(held, f, np.nan), {"long_name": study.file.attribute})}, chains),
        "posterior_predictive": xr.Dataset({"response": (_DIMS, np.where(held, response, -1), say)}, chains),
        "log_likelihood": _of_answers(log_likelihood, mask, cohort.names),
        "observed_data": xr.Dataset({"response": (_DIMS[2:], observed, say)}, coords),
        "constant_data": xr.Dataset(constants, coords, {"study": study.file.hash, "inference": study.inference}),
    }


def _attributes(parameter: Parameter) -> dict[str, Any]:
    """netCDF attributes of a parameter: its unit, or for levels the meaning of each number."""
    if not parameter.levels:
        return {"units": parameter.unit}
    return {"levels": ", ".join(f"{k} = {level}" for k, level in enumerate(parameter.levels))}


def _of_answers(
    values: Float[np.ndarray, "1 draws M n"], mask: Bool[np.ndarray, "M n"], names: Sequence[str]
) -> xr.Dataset:
    """The log-likelihoods of the used slots (`mask`) as a dataset with one dimension `obs_id`, by participant and then
    by response."""
    person, answer = np.nonzero(mask)
    chain, draw, *_ = values.shape
    coords = {
        "chain": np.arange(chain),
        "draw": np.arange(draw),
        "obs_id": np.arange(1, len(person) + 1),
        "participant": ("obs_id", np.array(names, object)[person]),
        "answer": ("obs_id", answer + 1),
    }
    return xr.Dataset({"response": (("chain", "draw", "obs_id"), values[..., person, answer])}, coords)


def inference_data(study: Study, cohort: Cohort, posteriors: Posterior, draws: int = 200, seed: int = 0) -> Any:
    """The groups as an `arviz.InferenceData`, equal to `arviz.from_netcdf` of inference.nc.

    `posteriors`: of the cohort's participants, stacked. Raises `InputError` if their shape is not the cohort's.
    """
    import arviz

    if posteriors.trials.mask.shape != cohort.trials.mask.shape:
        held, asked = posteriors.trials.mask.shape[0], len(cohort.names)
        raise InputError(
            f"inference_data: posteriors are of {held} people, the cohort is of {asked};"
            " hilbo.study.estimate.aggregate.fit_cohort makes those of a cohort."
        )

    return arviz.InferenceData(**groups(study, cohort, posteriors, draws, seed))  # type: ignore[arg-type]


def write_groups(datasets: dict[str, xr.Dataset], path: str | os.PathLike) -> None:
    """Write one netCDF file with a group per dataset; an existing file is overwritten."""
    for i, (name, data) in enumerate(datasets.items()):
        data.to_netcdf(path, mode="a" if i else "w", group=name, engine="h5netcdf")


def predictive_shares(datasets: dict[str, xr.Dataset], categories: int) -> tuple[np.ndarray, np.ndarray]:
    """Proportion of each category in the observed responses (C,), and in each draw of predicted ones (draws, C)."""
    observed = datasets["observed_data"]["response"].values
    held = observed >= 0
    predicted = datasets["posterior_predictive"]["response"].values[0][:, held]
    count = [np.mean(predicted == k, axis=1) for k in range(categories)]
    return np.bincount(observed[held], minlength=categories) / held.sum(), np.stack(count, axis=1)


@program
def _draw(
    posteriors: Posterior, keys: Key[Array, " M"], draws: int
) -> tuple[Float[Array, "M draws n"], Int[Array, "M draws n"], Float[Array, "M draws n"]]:
    """Draw latent scores, responses and log-likelihoods of the observed responses, each (M, draws, n), unused slots
    included."""

    def one(person):
        posterior, key = person
        trials, kernel = posterior.trials, posterior.gp.kernel
        covariance = gram(kernel, trials.x, trials.x)
        explained_root = posterior.latent.factor @ covariance
        values, vectors = eigh(covariance - explained_root.T @ explained_root)
        root = vectors * jnp.sqrt(jnp.where(values > 0, values, jnp.zeros_like(values)))[None, :]
        mean = covariance @ posterior.latent.weights
        first, second = jax.random.split(key)
        f = mean[None, :] + jax.random.normal(first, (draws, len(mean)), mean.dtype) @ root.T
        likelihood = posterior.gp.likelihood
        zero = jnp.zeros_like(mean)
        chances = jax.vmap(lambda row: jax.vmap(likelihood.class_probabilities)(row, zero))(f)
        below = jnp.cumsum(chances, axis=2)[..., :-1]
        uniform = jax.random.uniform(second, f.shape, f.dtype)
        answers = jnp.sum(uniform[..., None] > below, axis=2)
        log_likelihood = jax.vmap(lambda row: jax.vmap(likelihood.log_prob)(row, trials.q))(f)
        return f, answers, log_likelihood

    return jax.lax.map(one, (posteriors, keys))
