# %% [markdown]
# # Real data
# Two published data sets of ordinal responses: seventeen participants who rated compressed video clips (shipped), and
# eight who judged orientations in eight graded categories (not shipped: used if `orientation_confidence.csv` is
# here). The notebook estimates consistency, lapses and drift, and compares one map for all with individual optima.

# %%
import os
import tempfile
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
import pandas as pd

import hilbo
from hilbo import Study
from hilbo.population.judged.response_quality import excluded, measure_people
from hilbo.report.figures.people import people_figure
from hilbo.search.apart import nrmse
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.estimate.aggregate import aggregate_cohort
from hilbo.study.tables.trials import write_trials

DATA = Path(hilbo.__file__).parent / "data"  # studies and tables that are shipped

# %% [markdown]
# ## Video quality
# Responses to clips of nearly the same bitrate and height are paired. The clips of a pair have the same compression and
# different content, so that the agreement includes the effect of the content.

# %%
study = Study.load(DATA / "video_quality.toml")
cohort = cohort_of(read_trials(DATA / "video_quality.csv", study), study)
measured = measure_people(study.gp, cohort.trials, cohort.names)
print(measured[["participant", "trials", "consistency", "chance", "lapse", "drift"]].round(2).to_string(index=False))
print("left out by 'lapse_low > 0.3':", excluded(measured, "lapse_low > 0.3") or "nobody")

# %%
people_figure(measured, left_out=excluded(measured, "lapse_low > 0.3"))

# %% [markdown]
# Drift: number of 95 % intervals without 0; one in twenty is expected by chance.

# %%
drifted = (measured["drift_low"] > 0) | (measured["drift_high"] < 0)
print(int(drifted.sum()), "of", len(measured), "participants drifted; mean", round(measured["drift"].mean(), 2))

# %% [markdown]
# One map for all, and the individual optima.

# %%
aggregate = aggregate_cohort(study, cohort)
best = dict(
    zip(study.space.names, np.asarray(study.space.to_physical(aggregate.optimum.x)).round(1).tolist(), strict=True)
)
away = np.asarray(nrmse(aggregate.individuals.x, aggregate.optimum.x))
print("population optimum", best, "; individual optima away from it, median NRMSE", round(float(np.median(away)), 3))

# %% [markdown]
# ## Orientation and confidence
# Eight categories, orientation and contrast, with a hundred responses of each participant.

# %%
path = Path("orientation_confidence.csv")
count = int(os.environ.get("HILBO_NOTEBOOK_ANSWERS", "120"))
if path.exists():
    raw = pd.read_csv(path).groupby("subject", sort=False).head(count)
    limits = {name: (float(raw[name].min()), float(raw[name].max())) for name in ("orientation_deg", "contrast")}
    judged = Study.from_dict({
        "schema": 1,
        "study": {"name": "orientation", "responses": [f"grade {k}" for k in range(1, 9)], "attribute": "evidence"},
        "parameters": {
            "orientation_deg": dict(zip(("low", "high"), limits["orientation_deg"], strict=True)) | {"unit": "degree"},
            "contrast": dict(zip(("low", "high"), limits["contrast"], strict=True)) | {"scale": "log"},
        },
        "gp": {"theta": 10.0, "variance": 1.0, "thresholds": [-0.9, -0.5, -0.2, 0.0, 0.2, 0.5, 0.9], "noise": 0.5},
    })  # fmt: skip
    table = pd.DataFrame({
        "participant": raw["subject"].map("S{}".format),
        "trial": raw.groupby("subject").cumcount() + 1,
        "response": raw["response8"].map("grade {}".format),
        "orientation_deg": raw["orientation_deg"],
        "contrast": raw["contrast"],
    })  # fmt: skip
    file = Path(tempfile.mkdtemp()) / "orientation.csv"
    write_trials(table, file)
    seen = cohort_of(read_trials(file, judged), judged)
    answers = measure_people(judged.gp, seen.trials, seen.names)
    columns = ["participant", "trials", "consistency", "chance", "lapse", "lapse_low", "drift"]
    print(answers[columns].round(2).to_string(index=False))
else:
    print("orientation_confidence.csv is not here; the first part stands alone.")
