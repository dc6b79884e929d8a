"""A material's results for ArviZ: posterior, posterior predictive and observed responses as netCDF groups.

Groups and variables, all along the dimension obs_id, the fitted responses (draws also along chain and draw):

    posterior             f: latent score, drawn from N(mode, K - K C K)
    posterior_predictive  response: predicted responses (categories from 0)
    log_likelihood        response: log P(response | f)
    observed_data         response: the responses
    constant_data         one variable for each parameter, in its unit; thresholds and noise of the likelihood

Coordinates of obs_id: participant; answer, which counts each participant's fitted responses from 1; trial and session,
as in the trial table, where the cohort has them. Voided, warm-up and repeated responses are not included.
`arviz.from_netcdf` and `xarray.open_datatree` read the file. Each participant's posterior is separate, without pooling.
"""

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import xarray as xr
from jaxtyping import Array, Float, Int, Key

from hilbo.errors import InputError
from hilbo.kernels import gram
from hilbo.numerics.linalg import eigh
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Posterior
from hilbo.search.box import Parameter
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study

__all__ = ["groups", "inference_data", "predictive_shares", "write_groups"]

_DIMS = ("chain", "draw", "obs_id")


def groups(
    study: Study, cohort: Cohort, posteriors: Posterior, draws: int = 200, seed: int = 0
) -> dict[str, xr.Dataset]:
    """The groups as datasets, by name. `draws`: number of independent draws, as one chain, from `seed`."""
    keys = jax.random.split(jax.random.key(seed), len(cohort.names))
    drawn = (np.moveaxis(np.asarray(leaf), 0, 1)[None] for leaf in _draw(posteriors, keys, draws))
    person, answer = np.nonzero(np.asarray(cohort.trials.mask))
    f, response, log_likelihood = (values[..., person, answer] for values in drawn)
    coords = _coordinates(cohort, person, answer)
    chains = coords | {"chain": [0], "draw": np.arange(draws)}
    constants: dict[str, Any] = {
        p.name: ("obs_id", cohort.physical[person, answer, i], _attributes(p))
        for i, p in enumerate(study.space.parameters)
    }
    likelihood = jax.tree.map(lambda leaf: leaf[0], posteriors.gp).likelihood  # what a rule learnt, where it learns
    constants["thresholds"] = ("edge", np.asarray(likelihood.thresholds))
    constants["noise"] = ((), np.asarray(likelihood.noise))
    names = ", ".join(f"{k} = {label}" for k, label in enumerate(study.responses))
    say = {"long_name": "answer", "categories": names}
    observed = np.asarray(cohort.trials.q)[person, answer]
    return {
        "posterior": xr.Dataset({"f": (_DIMS, f, {"long_name": study.file.attribute})}, chains),
        "posterior_predictive": xr.Dataset({"response": (_DIMS, response, say)}, chains),
        "log_likelihood": xr.Dataset({"response": (_DIMS, log_likelihood)}, chains),
        "observed_data": xr.Dataset({"response": ("obs_id", observed, say)}, coords),
        "constant_data": xr.Dataset(constants, coords, {"study": study.file.hash, "inference": study.inference}),
    }


def _coordinates(cohort: Cohort, person: Int[np.ndarray, " n"], answer: Int[np.ndarray, " n"]) -> dict[str, Any]:
    """Coordinates of the fitted responses: rows `person` of the cohort, places `answer` from 0."""
    coords: dict[str, Any] = {
        "obs_id": np.arange(1, len(person) + 1),
        "participant": ("obs_id", np.array(cohort.names, object)[person]),
        "answer": ("obs_id", answer + 1),
    }
    if cohort.numbers is not None:
        coords["trial"] = ("obs_id", cohort.numbers[person, answer], {"long_name": "trial of the table"})
    if cohort.session is not None:
        coords["session"] = ("obs_id", np.array(cohort.sessions, object)[cohort.session[person, answer]])
    return coords


def _attributes(parameter: Parameter) -> dict[str, Any]:
    """netCDF attributes of a parameter: its unit, or for levels the meaning of each number."""
    if not parameter.levels:
        return {"units": parameter.unit}
    return {"levels": ", ".join(f"{k} = {level}" for k, level in enumerate(parameter.levels))}


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
    predicted = datasets["posterior_predictive"]["response"].values[0]
    count = [np.mean(predicted == k, axis=1) for k in range(categories)]
    return np.bincount(observed, minlength=categories) / observed.size, np.stack(count, axis=1)


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
