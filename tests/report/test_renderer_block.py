"""The [renderer] block that `hilbo identify` writes."""

from types import SimpleNamespace

import pytest

from hilbo.identification.characterise import Estimate
from hilbo.identification.sampled import Sampled
from hilbo.report.material import renderer_block


@pytest.mark.parametrize("status", ["identified", "one-sided", "at bound", "not identifiable"])
def test_the_effective_stiffness_has_its_status_beside_it(status):
    values = {"K0": -2.9, "K1": 5.7, "B1": 5.9, "alpha": 0.2, "K_eff": 0.44}
    fit = SimpleNamespace(model=Sampled(), parameters=lambda: values)
    estimates = {"K_eff": Estimate(0.44, None, None, status)}
    result = SimpleNamespace(fit=fit, estimates=estimates, minimum_damping=0.7)
    assert f"K_eff = 0.44       # N/mm, {status}\n" in renderer_block(result, None)
