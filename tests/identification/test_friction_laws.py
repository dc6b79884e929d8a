"""Damping of devices that follow one law of friction or another, from sweeps with noise."""

import numpy as np
import pytest

from hilbo.hardware_bridge import DeviceError
from hilbo.identification.motor.friction import Sweep, friction

LAWS = {
    "viscous + Coulomb": lambda v: 0.05 + 0.95 * v,
    "viscous + Coulomb + quadratic": lambda v: 0.05 + 0.95 * v + 17 * v**2,
    "viscous + Coulomb + Stribeck": lambda v: 0.05 + 0.95 * v + 0.1 * np.exp(-v / 0.02),
}


def sweeps_of(law, seed, noise=1.5e-3):
    """24 periods of four sweeps between 10 and 55 mm/s; `law`: friction (N) at a speed (m/s)."""
    rng, made = np.random.default_rng(seed), []
    for period, speed in enumerate(np.geomspace(10.0, 55.0, 24)):
        for way in (1, -1):
            for turn in (True, False):
                v = speed * rng.uniform(0.97, 1.03)
                a = way * rng.normal(300, 30) if turn else rng.normal(0, 5)
                force = way * law(v / 1e3) + 0.09 * a / 1e3 + 0.01 + noise * rng.standard_normal()
                made.append(Sweep(force, way * v, a, period))
    return made


@pytest.mark.parametrize("name", list(LAWS))
def test_the_law_is_named_and_damping_is_never_promised_above_the_truth(name):
    results = [friction(sweeps_of(LAWS[name], seed)) for seed in range(5)]
    assert sum(result.law == name for result in results) >= 4
    assert all(result.damping.lower <= 0.96 <= result.damping.upper + 0.02 for result in results)
    if name == "viscous + Coulomb":
        assert all(result.damping.upper - result.damping.lower < 0.2 for result in results)
        assert results[0].added is None


def test_a_law_of_no_kind_is_refused():
    def sticking(v):
        return 0.05 + 0.95 * v + 0.05 * (v > 0.025)

    with pytest.raises(DeviceError, match="follows none of the laws that are known"):
        friction(sweeps_of(sticking, 0))
