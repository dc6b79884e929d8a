# %% [markdown]
# # Quick start
# One participant, from responses to a posterior, and a session in ask-and-tell form.

# %%
import os
from pathlib import Path

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import hilbo
from hilbo import RBF, OrdinalGP, OrdinalProbit, Session, Study, Trials, fit

DATA = Path(hilbo.__file__).parent / "data"  # studies and tables that are shipped

# %% [markdown]
# ## A posterior
# Points are in the unit cube; responses are categories, 0 = "different", 1 = "similar", 2 = "close".

# %%
gp = OrdinalGP(kernel=RBF(theta=30.0), likelihood=OrdinalProbit(thresholds=(-0.5, 0.5), noise=0.5))
x = np.array([[0.1, 0.2], [0.4, 0.5], [0.45, 0.55], [0.9, 0.8]])
posterior = fit(gp, Trials.from_arrays(x, np.array([0, 1, 2, 0])))
mean, variance = posterior.predict(jnp.array([[0.5, 0.6], [0.0, 1.0]]))
print("mean", mean, "sd", jnp.sqrt(variance))
print("probabilities of different, similar, close:", posterior.class_probabilities(jnp.array([[0.5, 0.6]]))[0])

# %% [markdown]
# Predicted responses of this participant, from one corner of the space to the other.

# %%
line = jnp.linspace(0.0, 1.0, 101)
chances = posterior.class_probabilities(jnp.stack([line, line], axis=1))
plt.stackplot(line, chances.T, labels=["different", "similar", "close"])
plt.xlabel("both parameters, in parts of their ranges")
plt.ylabel("probability of each answer")
plt.legend()
plt.show()

# %% [markdown]
# Convergence diagnostics of the fit: the residual bounds the distance to the exact mode in prior standard deviations.

# %%
print(posterior.certificate)

# %% [markdown]
# Everything is differentiable, here the log evidence with respect to theta and the noise.


# %%
def log_evidence(theta, noise):
    model = OrdinalGP(RBF(theta), OrdinalProbit((-0.5, 0.5), noise))
    return fit(model, posterior.trials, throw=False).log_evidence


print(jax.grad(log_evidence, (0, 1))(30.0, 0.5))

# %% [markdown]
# ## A session
# The study file specifies the session; each response gives the next state. The next point is inside the passive set.

# %%
session = Session.start(Study.load(DATA / "paper.toml"), seed=1)
truth = np.array([5.70, 5.89, 0.203])
for _ in range(int(os.environ.get("HILBO_NOTEBOOK_TRIALS", "25"))):
    point = session.ask()
    miss = np.abs(np.array(list(point.values())) - truth) / [31, 32, 0.98]
    session = session.tell("close" if miss.max() < 0.1 else "similar" if miss.max() < 0.3 else "different")
print(len(session.answers), "answers; the best rendering so far:", session.best())
