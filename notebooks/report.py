# %% [markdown]
# # The paper's study, simulated
# Simulated participants compare three materials, respond "different", "similar" or "close", and take part in validation
# sessions; the files of such a study are in one folder, from which `hilbo report` writes the results section.

# %%
import dataclasses
import os
import tempfile
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
import pandas as pd

import hilbo
from hilbo import Study
from hilbo.report.figures.maps import map_slices
from hilbo.report.study.report import write_study
from hilbo.search.candidates import search_points
from hilbo.simulation.presets import PRESETS
from hilbo.simulation.simulate import people, simulate_study, to_table, truth_table
from hilbo.simulation.validation_sessions import sets_table, validation_table
from hilbo.study.analysis.best_mid_worst import best_mid_worst
from hilbo.study.cohort import cohort_of, read_trials
from hilbo.study.estimate.aggregate import aggregate_cohort
from hilbo.study.folder import read_folder
from hilbo.study.tables.trials import write_trials

DATA = Path(hilbo.__file__).parent / "data"  # studies and tables that are shipped

folder = Path(tempfile.mkdtemp())
participants, trials = 6, int(os.environ.get("HILBO_NOTEBOOK_TRIALS", "25"))

# %% [markdown]
# ## Three materials
# They share the study file; each has its own set as the centre of the individual optima. (A different effective
# stiffness of a material is specified in `[materials.NAME.renderer]`.)

# %%
MATERIALS = {
    "memory foam": {"K1": 5.70, "B1": 5.89, "alpha": 0.203},
    "medium silicone": {"K1": 4.00, "B1": 8.00, "alpha": 0.150},
    "stiff silicone": {"K1": 8.00, "B1": 4.00, "alpha": 0.120},
}
text = (DATA / "paper.toml").read_text().replace("trials = 25", f"trials = {trials}")
(folder / "study.toml").write_text(text)
study = Study.load(folder / "study.toml")

# %% [markdown]
# ## Sessions
# Trials are selected as in a real session. The simulated participants are described in docs/methods/simulation.md.

# %%
answers, truths, sets, compared = [], [], [], []
for number, (name, truth) in enumerate(MATERIALS.items()):
    population = dataclasses.replace(PRESETS["paper"], truth=truth)
    crowd = people(study, population, participants, seed=number)
    table = to_table(study, simulate_study(study, crowd, seed=number))
    answers.append(table.assign(material=name))
    truths.append(truth_table(study, population, crowd).assign(material=name))
    write_trials(table, folder / "one.csv")
    cohort = cohort_of(read_trials(folder / "one.csv", study), study)
    aggregate = aggregate_cohort(study, cohort, alternatives=False)
    three = best_mid_worst(study, aggregate.surface, search_points(study.space, 0))
    renderings = sets_table(study, three, np.asarray(aggregate.individuals.x))
    judged = validation_table(study, population, renderings, participants=8, judges=4, seed=number)
    prefix = f"{name}: "
    sets.append(renderings.assign(set_id=prefix + renderings["set_id"], material=name))
    for column in ("set_a", "set_b", "preferred"):
        judged[column] = prefix + judged[column]
    compared.append(judged.assign(material=name))
write_trials(pd.concat(answers), folder / "trials.csv")
pd.concat(truths).to_csv(folder / "truth.csv", index=False)
pd.concat(sets).to_csv(folder / "sets.csv", index=False)
pd.concat(compared).to_csv(folder / "validation.csv", index=False)
(folder / "one.csv").unlink()

# %% [markdown]
# ## The report
# The same as `hilbo report FOLDER --out results --no-compare`.

# %%
out = folder / "results"
out.mkdir()
content = write_study(read_folder(folder), out, comparison=False)
for claim in content["hypotheses"]:
    print(claim["number"])
    for item in claim["evidence"]:
        print("   ", item["side"], "-", item["text"])
print("written:", len(list(out.rglob("*"))), "files,", out / "report.html")

# %% [markdown]
# The map of the last material; the star is its optimum.

# %%
map_slices(study, aggregate.surface, aggregate.optimum.x, cohort)
