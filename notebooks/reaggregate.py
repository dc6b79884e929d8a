# %% [markdown]
# # Re-aggregating a data set
# Seventeen participants rated compressed video clips from bad to excellent. Their responses are aggregated into one
# population map over bitrate and height; any subset of participants and any prefix of trials can be aggregated again.
# Replace the study file and the table by your own.

# %%
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import numpy as np

import hilbo
from hilbo import Study
from hilbo.report.figures.maps import map_slices
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.estimate.aggregate import aggregate_cohort, fit_cohort
from hilbo.study.estimate.optimum import population_optimum, predict_people

DATA = Path(hilbo.__file__).parent / "data"  # studies and tables that are shipped

study = Study.load(DATA / "video_quality.toml")
cohort = cohort_of(read_trials(DATA / "video_quality.csv", study), study)
print(len(cohort.names), "people,", int(cohort.counts().sum()), "answers")

# %% [markdown]
# ## The map and its optimum

# %%
aggregate = aggregate_cohort(study, cohort)
best = dict(zip(study.space.names, np.asarray(study.space.to_physical(aggregate.optimum.x)), strict=True))
print("highest at", best, "with", float(aggregate.optimum.mean), "±", float(aggregate.optimum.sd))
print(
    "answers to expect there:",
    dict(zip(study.responses, np.asarray(aggregate.optimum.class_probabilities), strict=True)),
)

# %%
map_slices(study, aggregate.surface, aggregate.optimum.x, cohort)

# %% [markdown]
# ## Half the participants, or a third of the trials
# The map is a sum of individual contributions, so that leaving participants out is cheap.

# %%
candidates = jnp.asarray(study.space.candidates(2048, 0))
for words, part in (("first eight people", cohort.of(cohort.names[:8])), ("first 23 trials", cohort.first(23))):
    optimum = population_optimum(study, fit_cohort(study, part), candidates)
    print(words, np.asarray(study.space.to_physical(optimum.x)), "sd", float(optimum.sd))

# %% [markdown]
# The precision of the map increases with the number of participants everywhere, if they are noisy views of one
# function, as the committee machine assumes.

# %%
points = candidates[:5]
for count in (1, 4, 17):
    _, variance = predict_people(fit_cohort(study, cohort.of(cohort.names[:count])), points)
    print(count, "people: sd", np.round(np.sqrt(variance), 3))
