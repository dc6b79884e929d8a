"""Hyperparameters and answers that nobody should choose: every fit converges, or says that it did not.

Noise 1e-3 to 10, theta 1e-2 to 1e4, variance 1e-3 to 1e4; one category only, conflicting repeats, answers independent
of x; 0, 1, 25 and 200 of them. Wider ranges and the other inferences: tests/inference/test_stress.py,
docs/results/accuracy.md.
"""

from itertools import product

import jax.numpy as jnp
import numpy as np
import pytest
from datasets import hostile_cases
from helpers import answers, complaint, model
from oracles import oracle

from hilbo import fit
from tests.vectors.laplace import NASTIEST, WITH_25, of_digits

CASES = list(hostile_cases())


def complaints(cases, dtype) -> list[str]:
    return [f"{case.name}: {wrong}" for case in cases if (wrong := complaint(case, dtype))]


def test_a_part_of_the_grid():
    part = CASES[::8]  # 8 and the 9 kinds of data have no common factor: every kind and every value occurs
    assert len(part) == 68
    assert complaints(part, np.float64) == []


@pytest.mark.deep
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_the_whole_grid(dtype):
    assert complaints(CASES, dtype) == []


def check_against_digits(case, exact):
    """|mean error| <= sqrt(k**) (residual + distance to the mode) <= 2 sqrt(k**) residual, and rounding."""
    posterior = fit(model(case), answers(case), throw=False)
    assert posterior.certificate.converged, case.name
    mean, variance = posterior.predict(jnp.asarray(case.x_new))
    weight = float(jnp.sum(jnp.abs(posterior.latent.weights)))
    rounding = 8 * np.finfo(float).eps * case.variance * weight
    bound = 2 * np.sqrt(case.variance) * float(posterior.certificate.residual) + rounding + 1e-15
    assert np.max(np.abs(mean - exact["mean"])) <= bound, case.name
    np.testing.assert_allclose(variance, exact["variance"], rtol=1e-5, err_msg=case.name)
    np.testing.assert_allclose(posterior.log_evidence, float(exact["log_evidence"]), rtol=1e-5, err_msg=case.name)


def test_against_25_digits():
    """The residual in the certificate bounds the error of the mean, also where the condition is 1e11."""
    for case in [*WITH_25[::15], *NASTIEST]:
        check_against_digits(case, oracle("laplace_digits")[case.name])


@pytest.mark.deep
@pytest.mark.release  # minutes of mpmath
def test_all_of_25_answers_against_25_digits():
    for case in WITH_25:
        check_against_digits(case, of_digits(case))


def test_the_grid_is_what_the_docstring_says():
    assert {case.noise for case in CASES} == {1e-3, 1e-2, 0.1, 0.5, 10.0}
    assert {case.theta for case in CASES} == {1e-2, 1.0, 30.0, 1e4}
    assert {case.variance for case in CASES} == {1e-3, 1.0, 1e4}
    assert {len(case.q) for case in CASES} == {0, 1, 25, 200}
    combinations = set(product((1e-3, 1e-2, 0.1, 0.5, 10.0), (1e-2, 1.0, 30.0, 1e4), (1e-3, 1.0, 1e4)))
    assert combinations == {(case.noise, case.theta, case.variance) for case in CASES}
    assert len(NASTIEST) == 3
