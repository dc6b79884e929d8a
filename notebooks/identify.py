# %% [markdown]
# # From a creep and relaxation table to a passive search space
# Sixteen relaxation tests (a position is applied) and sixteen creep tests (a force is applied) of a soft foam, as a
# logger wrote them. They are simulated, with known parameters: K0 = -2.89, K1 = 5.70, B1 = 5.89, alpha = 0.203.

# %%
import jax

jax.config.update("jax_enable_x64", True)

import os
import tomllib
from pathlib import Path

import numpy as np

import hilbo
from hilbo import Study
from hilbo.identification.characterise import characterise
from hilbo.identification.fitting import fit, nrmse
from hilbo.identification.material_tables import read_material
from hilbo.identification.sampled import Sampled
from hilbo.report.figures.mechanics import curves_figure
from hilbo.report.material import renderer_block

DATA = Path(hilbo.__file__).parent / "data"  # studies and tables that are shipped

material = read_material(DATA / "memory_foam_simulated.csv")
for test in material.tests:
    print(test.kind, "-", test.repeats, "repeats,", test.time.size, "points to", test.time[-1], "s")

# %% [markdown]
# ## Fit
# One parameter set for both tests, with the memory of the rendering: N = 101 samples of 1 ms. The recorded input
# goes through the model, so that the ramp of the test is taken into account.

# %%
fitted = fit(material.tests, Sampled(N=101, T=1e-3))
print({name: round(value, 4) for name, value in fitted.parameters().items()})
print("NRMSE", {kind: f"{100 * value:.2f} %" for kind, value in nrmse(fitted).items()})

# %% [markdown]
# ## Precision
# Profile intervals, corrected for autocorrelated residuals, and a bootstrap over the repeats. K_inst and K_eff are well
# determined; K0, K1 and B1 are correlated and much less precise, although the curve is precise.

# %%
result = characterise(material.tests, Sampled(N=101))
for name, estimate in result.estimates.items():
    print(f"{name:7s} {estimate.value:8.4f}  {estimate.lower:8.4f} to {estimate.upper:8.4f}  {estimate.status}")

# %% [markdown]
# The tests, the fit, and the residuals.

# %%
curves_figure(material.tests, result)

# %% [markdown]
# ## Length of the memory
# The same tests fitted with other memories: parameters depend on N.

# %%
if "HILBO_NOTEBOOK_TRIALS" not in os.environ:  # the tests of the notebooks skip the slow part
    from hilbo.identification.memory_selection import select_memory

    for row in select_memory(material.tests):
        values = {name: round(value, 3) for name, value in row.fit.parameters().items()}
        print(row.N or "full", {kind: f"{100 * e:.2f} %" for kind, e in row.nrmse.items()}, values)

# %% [markdown]
# ## Search space of a study
# The [renderer] block goes into a study file; the search space of K1, B1 and alpha is then the passive part of
# the box on a device with this damping, with the effective stiffness of the material.

# %%
block = renderer_block(result, damping=0.95)
print(block)
paper = tomllib.loads((DATA / "paper.toml").read_text())
study = Study.from_dict(paper | tomllib.loads(block))
candidates = study.space.candidates(1000, seed=0)
values = result.fit.parameters()
margin = study.space.passivity_margin({name: np.array(values[name]) for name in ("K1", "B1", "alpha")})
print("margin of the identified set:", float(margin), "N.s/m")
print("passive candidates:", len(candidates), "; all feasible:", bool(np.all(study.space.feasible(candidates))))
