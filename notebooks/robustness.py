# %% [markdown]
# # Robustness to the hyperparameters
# Shift of the population optimum when the hyperparameters are optimised in place of those of the study file.
# The same as `hilbo robustness`, with real ratings of compressed video. Replace the study file and the table by your
# own.

# %%
import os
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import hilbo
from hilbo import Study
from hilbo.report.figures.maps import map_slices
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.robustness.robustness import robustness

DATA = Path(hilbo.__file__).parent / "data"  # studies and tables that are shipped

study = Study.load(DATA / "video_quality.toml")
cohort = cohort_of(read_trials(DATA / "video_quality.csv", study), study)
if "HILBO_NOTEBOOK_TRIALS" in os.environ:  # fewer people, so that the notebook is quick when it is tested
    cohort = cohort.of(cohort.names[:4]).first(15)
check = robustness(study, cohort)

# %% [markdown]
# ## Both optima
# For the committee the criterion is the evidence of each participant's responses given those of all others.

# %%
for name, place in (("study file", check.fixed), ("optimised", check.optimised)):
    values = np.asarray(study.space.to_physical(place.optimum.x)).round(1)
    print(name, dict(zip(study.space.names, values.tolist(), strict=True)), "with", place.answers, "answers near it")
print(f"The optimum moves by {100 * check.nrmse:.1f} % of the search ranges (NRMSE).")

# %% [markdown]
# ## Comparison with the sampling error
# Compare the shift with the sampling error: the optimum of resamples of the participants, with the hyperparameters of
# the study file.

# %%
if check.resampled is not None:
    low, middle, high = 100 * np.percentile(check.resampled.fixed, [25, 50, 75])
    print(f"Resamples of the people move it by {middle:.1f} % (median; quartiles {low:.1f} and {high:.1f} %).")

# %% [markdown]
# ## Both maps
# With the hyperparameters of the study file, and with optimised ones; the stars are the optima.

# %%
map_slices(study, check.fixed_aggregate.surface, check.fixed.optimum.x, cohort)

# %%
map_slices(study, check.optimised_aggregate.surface, check.optimised.optimum.x, cohort)
