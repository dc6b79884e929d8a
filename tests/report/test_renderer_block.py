"""The [renderer] block that `hilbo identify` writes."""

import tomllib

import pytest
from partly import partly

from hilbo.identification.characterise import Characterisation, Estimate
from hilbo.identification.fitting import Fit
from hilbo.identification.sampled import Sampled
from hilbo.report.material import renderer_block


def result(status="identified", **model):
    values = {"K0": -2.9, "K1": 5.7, "B1": 5.9, "alpha": 0.2, "K_eff": 0.44}
    fit = partly(Fit, model=Sampled(**model), parameters=lambda: values)
    estimates = {"K_eff": Estimate(0.44, None, None, status)}
    empty = Characterisation(*[None] * len(Characterisation._fields))
    return empty._replace(fit=fit, estimates=estimates, minimum_damping=0.7)


@pytest.mark.parametrize("status", ["identified", "one-sided", "at bound", "not identifiable"])
def test_the_effective_stiffness_has_its_status_beside_it(status):
    assert f"K_eff = 0.44       # N/mm, {status}\n" in renderer_block(result(status), None)


def test_period_and_damping_are_read_back_as_they_were():
    """A device refuses a set of another T, and a study that counts on more damping than it has."""
    period, damping = 1 / 3000, 0.95123458
    block = tomllib.loads(renderer_block(result(T=period), damping))["renderer"]
    assert (block["T"], block["damping"]) == (period, damping)
