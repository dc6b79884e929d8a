# %% [markdown]
# # Which aggregation when
# People who agree, and people who do not: the same rules merge both, and leaving one person out at a time says which of
# them may be believed for somebody new.

# %%
import dataclasses
import os
import tomllib
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

from hilbo import Study
from hilbo.report.comparison import comparison_table
from hilbo.simulation.presets import PRESETS
from hilbo.simulation.simulate import people, simulate_study, to_table
from hilbo.study.aggregate import aggregate_cohort
from hilbo.study.cohort import Cohort, cohort_of
from hilbo.study.rule_comparison import compare
from hilbo.study.trial_table import read_trials

trials = int(os.environ.get("HILBO_NOTEBOOK_TRIALS", "10"))
SHOWN = ["rule", "negative_log_density", "negative_log_density_error", "central_95", "z2", "optimum_sd"]

# %% [markdown]
# ## Simulated people whose optima scatter, more or less
# The preset `paper` scatters people's optima by a third of the range of K1; `alike` hardly scatters them at all.

# %%
raw = tomllib.loads(Path("hilbo/data/paper.toml").read_text())
raw["selection"]["trials"] = trials
study = Study.from_dict(raw)
for words, spread in (("alike", (0.02, 0.02, 0.02)), ("as in the preset", PRESETS["paper"].spread)):
    population = dataclasses.replace(PRESETS["paper"], spread=spread)
    answers = simulate_study(study, people(study, population, 6, seed=1), seed=1)
    table = to_table(study, answers)
    cohort = Cohort(answers, np.asarray(study.space.to_physical(answers.x)), tuple(table["participant"].unique()))
    found = compare(study, aggregate_cohort(study, cohort, alternatives=False))
    print(words, "-", found["recommendation"])
    print(comparison_table(found)[SHOWN].round(3).to_string(index=False), "\n")

# %% [markdown]
# ## Real people: video quality
# Six of the seventeen; all of them take a minute: `hilbo aggregate ... --compare`.

# %%
video = Study.load("hilbo/data/video_quality.toml")
everybody = cohort_of(read_trials("hilbo/data/video_quality.csv", video), video)
found = compare(video, aggregate_cohort(video, everybody.of(everybody.names[:6]).first(20), alternatives=False))
print(found["recommendation"])
print(comparison_table(found)[SHOWN].round(3).to_string(index=False))
