"""A part of the stress grid, for every inference: a fit ends well, or says that it did not (benchmarks/stress.py)."""

import numpy as np
import pytest
from stress_cases import AXES, COUNTS, reference, stress_cases

from benchmarks.stress import INFERENCES, _committee, fit_case

SMALL = list(stress_cases("small", 240))
OF_THREE = [case for case in SMALL if len(case.thresholds) == 2]  # one compilation for each inference

# Float32 fits whose residual is small in prior standard deviations while the evidence, which sees the noise, is wrong.
BETWEEN_SCALES = (
    ("laplace", "noise=0.0001 theta=100000 variance=1000 gap=0.01 categories=2 dimensions=1 conflicting n=1"),
    ("laplace", "noise=0.0001 theta=30 variance=1000 gap=1 categories=2 dimensions=1 one category n=25"),
    ("ep", "noise=0.1 theta=0.001 variance=1000 gap=100 categories=3 dimensions=2 one point n=25"),
    ("ep", "noise=0.001 theta=1000 variance=0.001 gap=100 categories=10 dimensions=20 conflicting n=7"),
)


def faults(cases, inference, dtype):
    """What is wrong with fits that call themselves right; where there is a reference, it is asked."""
    for case in cases:
        known = None if inference == "laplace" else reference(case)
        outcome = fit_case(case, "small", inference, dtype, known and (known[0], known[1][:3]))
        if outcome.wrong:
            yield f"{case.name}: {outcome.wrong}"


# A few seconds each; that of EP has its part of the hostile grid by default (test_ep.py).
@pytest.mark.parametrize(
    "inference", ["laplace", *(pytest.param(i, marks=pytest.mark.deep) for i in ("ep", "ep_corrected"))]
)
def test_a_part_of_the_grid(inference):
    assert list(faults(OF_THREE[::4], inference, np.float64)) == []


MINUTES = ("exact",)  # of sampling in each number type


@pytest.mark.deep
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize(
    "inference", [pytest.param(i, marks=[pytest.mark.release] if i in MINUTES else []) for i in INFERENCES]
)
def test_all_small_cases(inference, dtype):
    assert list(faults(SMALL, inference, dtype)) == []


@pytest.mark.deep
@pytest.mark.parametrize(("inference", "name"), BETWEEN_SCALES)
def test_float32_says_no_where_the_evidence_is_not_to_be_had(inference, name):
    (case,) = [case for case in SMALL if case.name == name]
    assert fit_case(case, "small", inference, np.float64, None).converged
    assert not fit_case(case, "small", inference, np.float32, None).converged


@pytest.mark.parametrize("strongest", [-9, 0])
def test_a_committee_of_a_thousand(strongest):
    for prior in (1e-6, 1e6):
        assert np.max(_committee(1000, prior, strongest, np.float64)) < 1e-12
        assert np.max(_committee(1000, prior, strongest, np.float32)) < 1e-4


@pytest.mark.deep
def test_the_grid_has_every_value_and_references_for_a_third():
    for name, values in {**AXES, "n": COUNTS["small"]}.items():
        if name == "kind":
            assert all(any(kind in case.name for case in SMALL) for kind in values)
        else:
            assert all(any(f"{name}={value:g} " in f"{case.name} " for case in SMALL) for value in values), name
    assert sum(reference(case) is not None for case in SMALL) >= 60
