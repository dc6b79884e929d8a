# %% [markdown]
# # Comparison of aggregation methods
# Participants with similar and with different optima are aggregated by the same methods; leave-one-participant-out
# cross-validation shows which method predicts the responses best.

# %%
import dataclasses
import os
import tomllib
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np

import hilbo
from hilbo import Study
from hilbo.report.figures.population import rules_figure
from hilbo.report.study.comparison import comparison_table
from hilbo.simulation.presets import PRESETS
from hilbo.simulation.simulate import people, simulate_study, to_table
from hilbo.study.analysis.rule_comparison import compare
from hilbo.study.cohort import Cohort, cohort_of, read_trials
from hilbo.study.estimate.aggregate import aggregate_cohort

DATA = Path(hilbo.__file__).parent / "data"  # studies and tables that are shipped

trials = int(os.environ.get("HILBO_NOTEBOOK_TRIALS", "10"))
SHOWN = ["rule", "negative_log_density", "difference", "difference_error", "central_95", "z2", "optimum_sd"]

# %% [markdown]
# ## Simulated participants with different spreads of optima
# In the preset `paper` the individual optima have a spread of a quarter of the range of K1; in `alike` almost none.

# %%
raw = tomllib.loads((DATA / "paper.toml").read_text())
raw["selection"]["trials"] = trials
study = Study.from_dict(raw)
for words, spread in (("alike", (0.02, 0.02, 0.02)), ("as in the preset", PRESETS["paper"].spread)):
    population = dataclasses.replace(PRESETS["paper"], spread=spread)
    answers = simulate_study(study, people(study, population, 6, seed=1), seed=1)
    table = to_table(study, answers)
    cohort = Cohort(answers, np.asarray(study.space.to_physical(answers.x)), tuple(table["participant"].unique()))
    comparison = compare(study, aggregate_cohort(study, cohort, alternatives=False))
    print(words, "-", comparison["recommendation"])
    print(comparison_table(comparison)[SHOWN].round(3).to_string(index=False), "\n")

# %% [markdown]
# ## Real data: video quality
# Six of the seventeen participants; all of them take a minute: `hilbo aggregate ... --compare`.

# %%
video = Study.load(DATA / "video_quality.toml")
everybody = cohort_of(read_trials(DATA / "video_quality.csv", video), video)
comparison = compare(video, aggregate_cohort(video, everybody.of(everybody.names[:6]).first(20), alternatives=False))
print(comparison["recommendation"])
print(comparison_table(comparison)[SHOWN].round(3).to_string(index=False))

# %% [markdown]
# Loss against the best method, with two standard errors of the paired difference: a bar that reaches 0 is a tie.

# %%
rules_figure(comparison)
