"""The verbs of an analysis in Python: aggregate a table, read the optimum, predict at stimuli in physical units.

trials = read_trials("trials.csv", study)
result = aggregate(study, trials)
best(study, result)
predicted = predict(study, result, pd.DataFrame({"K1": [5.6], "B1": [7.9], "alpha": [0.18]}))
"""

import jax.numpy as jnp
import numpy as np
import pandas as pd

from hilbo.errors import InputError
from hilbo.numerics.shown import has_values
from hilbo.ordinal_gp import Posterior
from hilbo.search.rendering import Rendering
from hilbo.study.cohort import Cohort, cohort_of
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate, aggregate_cohort
from hilbo.study.formats.csv_file import FRAME, cells_of, parameter_values, place
from hilbo.study.tables.trials import TrialTable

__all__ = ["aggregate", "best", "predict"]


def aggregate(study: Study, trials: pd.DataFrame | TrialTable | Cohort, seed: int = 0) -> Aggregate:
    """Aggregate responses into the population map by the study's method, and find its optimum.

    **Arguments:** `trials`: a trial table, as `read_trials` returns it or a DataFrame of your own, or a cohort. `seed`:
    determines the points at which optima are searched.

    Other methods, and each participant's optimum, are left out; `aggregate_cohort` computes them. Raises `InputError`
    for an invalid table.
    """
    cohort = trials if isinstance(trials, Cohort) else cohort_of(trials, study)
    return aggregate_cohort(study, cohort, seed, alternatives=False, individuals=False)


def best(study: Study, model: Aggregate) -> dict[str, float | str]:
    """The population optimum in physical units: parameter -> value, levels by name, with K0 if the study has a
    renderer. Raises `InputError` for another type of model."""
    if not isinstance(model, Aggregate):
        raise InputError(f"best: model is a {type(model).__name__}; give an Aggregate.")
    return Rendering.at(study.space, model.optimum.x).shown


def predict(study: Study, model: Posterior | Aggregate, table: pd.DataFrame) -> pd.DataFrame:
    """Copy of the table with predictions for each row: `mean` and `sd` of the latent function, and for every response
    of the study its probability, in a column `P(response)`.

    **Arguments:**

    - `model`: one participant's [`Posterior`][]; or a study's [`Aggregate`][]: mean and standard deviation are then
      the population map's, and the responses those of a new participant.
    - `table`: a column for each of the study's parameters, in its units, levels by name; other columns and the index
      are kept.

    Raises `InputError` for another type of model, several participants' posteriors, a missing column, and values
    outside the study's ranges.
    """
    x = _points(study, table)
    if isinstance(model, Posterior):
        if not has_values(model.trials.mask) or model.trials.mask.ndim != 1:
            raise InputError("predict: the posterior is of several participants; give one of them, or the Aggregate.")
        mean, variance = model.predict(x)
        chances = model.class_probabilities(x)
    elif isinstance(model, Aggregate):
        mean, variance = model.surface(x)
        chances = model.class_probabilities(model.likelihood, x)
    else:
        raise InputError(f"predict: model is a {type(model).__name__}; give a Posterior or an Aggregate.")
    predicted = {"mean": np.asarray(mean), "sd": np.sqrt(np.asarray(variance))}
    predicted |= {f"P({label})": column for label, column in zip(study.responses, np.asarray(chances).T, strict=True)}
    return table.assign(**predicted)


def _points(study: Study, table: pd.DataFrame) -> jnp.ndarray:
    """The rows as points (m, d) of the unit cube. Raises InputError for a missing column or an invalid value."""
    text = cells_of(table)
    missing = [name for name in study.space.names if name not in text]
    if missing:
        wanted = ", ".join(study.space.names)
        raise InputError(f'{place(FRAME)}column "{missing[0]}" is missing; a rendering of this study has {wanted}.')
    columns = []
    for p in study.space.parameters:
        columns.append(parameter_values(text, p, FRAME))
    return jnp.asarray(study.space.to_unit(jnp.asarray(np.stack(columns, axis=1))))
