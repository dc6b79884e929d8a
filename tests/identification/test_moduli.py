"""Models of moduli against the exact references and published fits of real fish muscle."""

import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import viscoelastic
from hilbo.identification.fitting import Test, fit, nrmse
from hilbo.identification.material_tables import read_material
from hilbo.identification.moduli import Continuous, FractionalMaxwell
from hilbo.numerics.mittag_leffler import mittag_leffler

TIMES = np.geomspace(0.01, 1000, 40)
ONE = jnp.ones(1)
SET = (0.44, 1.2, 3.0, 0.35)  # K0, K1, B1, alpha


def q_of(K0, K1, B1, alpha, reference):
    return jnp.array([K0 + K1, K0, np.log(K1 * reference**alpha / B1), np.log(alpha / (1 - alpha))])


@pytest.mark.parametrize("kind", ["modulus", "compliance"])
def test_curves_are_the_exact_ones(kind):
    reference = viscoelastic.relaxation_modulus if kind == "modulus" else viscoelastic.creep_compliance
    expected = np.asarray(reference(TIMES, *SET))
    model = Continuous().at([Test(kind, TIMES, expected[None])])
    curve = model.prepare(Test(kind, TIMES, expected[None]))
    q = q_of(*SET, float(model.reference))
    np.testing.assert_allclose(model.predict(q, curve, ONE), expected, rtol=1e-10)
    values = {name: float(value) for name, value in model.parameters(q).items()}
    assert [values[n] for n in ("K0", "K1", "B1", "alpha")] == pytest.approx(SET)


def test_a_maxwell_model_without_its_second_springpot():
    """β = 0: a spring in series with a spring-pot, G(t) = G·E_α(-(t/τ)^α)."""
    model, test = FractionalMaxwell(), Test("modulus", TIMES, 1 / TIMES[None])
    q = jnp.array([np.log(5.0), np.log(30.0), 0.6, 0.0])
    expected = 5 * mittag_leffler(0.6, (TIMES / 30) ** 0.6)
    np.testing.assert_allclose(model.predict(q, model.prepare(test), ONE), expected, rtol=1e-9)
    assert float(model.parameters(q)["G"]) == pytest.approx(5.0)


def fish(longest=None):
    return read_material("hilbo/data/fish_muscle.csv", longest=longest).tests


@pytest.mark.deep
@pytest.mark.parametrize(("longest", "limit"), [(3.0, 0.0115), (None, 0.023)])
def test_fish_muscle_by_the_exact_fosls(longest, limit):
    assert nrmse(fit(fish(longest), Continuous()))["modulus"] <= limit


@pytest.mark.deep
def test_fish_muscle_by_fractional_maxwell():
    """The published weighted fit: G 22074, V 869958, α .6744, β .1101, weighted sum of squares .01076."""
    fitted = fit(fish(), FractionalMaxwell())
    values = fitted.parameters()
    assert values["alpha"] == pytest.approx(0.6744, rel=0.01)
    assert values["beta"] == pytest.approx(0.1101, rel=0.01)
    assert values["G"] == pytest.approx(22074, rel=0.01)
    assert values["V"] == pytest.approx(869958, rel=0.02)
    assert float(fitted.solution.cost) * 566 == pytest.approx(0.01076, rel=2e-3)
