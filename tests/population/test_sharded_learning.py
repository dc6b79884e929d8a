"""The learnt model of people who are sharded over four devices, against one device."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CODE = """
import sys
import jax, numpy as np
from jax.flatten_util import ravel_pytree
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, "tests/support")
from studies import STUDY, population_answers
from hilbo.numerics.sharding import host_local, people_mesh
from hilbo.population.learnt.posterior import KERNELS, LEFT, NOTHING, Problem, cost_at, medians, model_at
from hilbo.population.learnt.search import LARGEST
from hilbo.population.maps import learnt_map
from hilbo.population.rules.recipes import LEARNT_2
from hilbo.population.shared.features import pivots_for
from hilbo.population.shared.tallies import tallied
from hilbo.search.candidates import search_points
from hilbo.study.cohort import cohort_of
from hilbo.study.estimate.learnt import resolved, that_learns
from hilbo.study.estimate.optimum import map_optimum

cohort = cohort_of(population_answers(13), STUDY)
answers = tallied(cohort.trials, 3)
at = medians(answers, NOTHING, LEARNT_2.priors, KERNELS[LEARNT_2.kernel])
model = model_at(at, answers, NOTHING, KERNELS[LEARNT_2.kernel])
pivots = pivots_for(model.unit, answers, LEFT, most=LARGEST)
problem = Problem(answers, NOTHING, LEARNT_2.priors, KERNELS[LEARNT_2.kernel], pivots, model.theta)

def found():
    cost = cost_at(at, answers.blank, problem)
    study = resolved(that_learns(STUDY), cohort)
    optimum = map_optimum(study, learnt_map(study.learnt, cohort.trials), search_points(STUDY.space, 0))
    return cost.log_evidence, ravel_pytree(cost.gradient)[0], optimum.x

one = found()
with jax.set_mesh(people_mesh()):
    four = host_local(found())
for name, a, b, most in zip(("evidence", "gradient", "optimum"), one, four, (1e-10, 1e-10, 1e-6)):
    print(name, float(np.max(np.abs(a - b))))
    np.testing.assert_allclose(b, a, rtol=0, atol=most)
"""


@pytest.mark.deep  # learning twice, in a process of its own
def test_four_devices_learn_what_one_does():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", CODE], env=environment, cwd=ROOT, check=True)
