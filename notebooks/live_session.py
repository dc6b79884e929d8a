# %% [markdown]
# # A dry run: a session without a participant
# A simulated participant uses a simulated device through the same code as the pages of `hilbo session`: the
# log on disk, the event-sourced state, the look-ahead. Only the browser is left out; `hilbo simulate --live` has it.

# %%
import jax

jax.config.update("jax_enable_x64", True)

import os
import tempfile
import time
from pathlib import Path

import hilbo
from hilbo.app.pages.session_views import participant_view
from hilbo.app.rehearsal.rehearsal import Decider
from hilbo.hardware_bridge import Renderer
from hilbo.report.figures.maps import map_slices
from hilbo.session.choose.look_ahead import LiveChooser
from hilbo.session.export.tables import read_log_trials
from hilbo.session.log.actions import answer, go_on, present, propose, sent
from hilbo.session.log.event_log import EventLog
from hilbo.session.log.header import header_for
from hilbo.session.log.log_files import log_name
from hilbo.simulation.presets import preset_of
from hilbo.study.cohort import cohort_of
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import aggregate_cohort

DATA = Path(hilbo.__file__).parent / "data"  # studies and tables that are shipped

# %% [markdown]
# ## The study and its session
# 25 trials; here a few, so that the notebook is quick when it is tested.

# %%
paper = DATA / "paper.toml"
text = paper.read_text()
if "HILBO_NOTEBOOK_TRIALS" in os.environ:
    text = text.replace("trials = 25", f"trials = {os.environ['HILBO_NOTEBOOK_TRIALS']}")
folder = Path(tempfile.mkdtemp())
(folder / "study.toml").write_text(text + "\n[session.warm_up]\ncount = 2\n")
study = Study.load(folder / "study.toml")
header = header_for(study.file, "P01", seed=0)
log = EventLog.create(folder / log_name(header), study.file, header)
chooser = LiveChooser(log.state)
chooser.warm()
decide = Decider(study, preset_of("paper"), seed=0)
device = Renderer.open("sim", options={"finger": "none"})

# %% [markdown]
# ## The session
# Every line that ends in `append` is on the disk when it returns.

# %%
mechanics = study.space.mechanics
while log.state.screen not in ("done", "ended"):
    if log.state.screen == "ready":  # the end of the warm-up
        log.append(go_on(log.state, time.time()))
        continue
    log.append(propose(log.state, chooser, time.time()))
    trial = log.state.pending
    numbers = {name: trial.renderings["a"][name] for name in ("K0", "K1", "B1", "alpha")}
    confirmed = device.send(**numbers, N=mechanics.N, T=mechanics.T)
    log.append(sent(log.state, trial.id, "a", time.time(), in_force=confirmed._asdict()))
    for step, _ in enumerate(log.state.steps_of(trial)):
        log.append(present(log.state, trial.id, step, True, time.time()))
        chooser.lookahead(log.state)  # while somebody feels
        log.append(present(log.state, trial.id, step, False, time.time()))
    label = decide({"renderings": trial.renderings}, "class_a")
    log.append(answer(log.state, trial.id, "notebook", {"class_a": label}, time.time()))
    print(f"{trial.data['phase']:>12} {trial.number:2d}  K1 {numbers['K1']:5.2f}  B1 {numbers['B1']:5.2f}", end="  ")
    print(f"alpha {numbers['alpha']:.3f}  {label}")
device.close()

# %% [markdown]
# ## The participant's view

# %%
print(participant_view(log.state)["message"])

# %% [markdown]
# ## Replaying the log
# The replayed log gives the same state. No fit delayed a trial.

# %%
log.close()
with EventLog.resume(log.path, study.file) as again:
    print("the same state:", again.state == log.state, "in", again.state.seq, "events")
print("looked up:", chooser.looked_up, "computed while somebody felt:", chooser.fits)

# %% [markdown]
# ## This participant's map
# The responses of the log's folder as a table, and the resulting map; the star is its optimum.

# %%
cohort = cohort_of(read_log_trials(folder, study.file), study)
aggregate = aggregate_cohort(study, cohort)
map_slices(study, aggregate.surface, aggregate.optimum.x, cohort)
