"""Which K1 a device and a range of effective damping leave: ends that the model itself confirms."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from hilbo import passivity
from hilbo.mechanics.delay import least_damping
from hilbo.search.box import Mechanics, Parameter
from hilbo.search.columns import Columns
from hilbo.search.feasibility import (
    SEARCH_MARGIN,
    K0_of,
    K1_range,
    allowed,
    largest_K1,
    minimum_damping,
)
from hilbo.viscoelastic import FOSLS

DAMPED = Mechanics(K_eff=0.44, damping=0.95, effective_damping=(10.0, 80.0))
B1, ALPHA = jnp.array([7.88, 0.01]), jnp.array([0.176, 0.176])  # of the second, every K1 is damped less than that


def test_the_ends_of_a_damping_range_have_its_dampings():
    low, high = K1_range(DAMPED, B1, ALPHA)
    for K1, damping in ((low, 10.0), (high, 80.0)):
        model = FOSLS(0.0, float(K1[0]), B1[0], ALPHA[0])
        np.testing.assert_allclose(model.effective_damping(), damping, rtol=1e-12)
    assert np.isinf(low[1]) and np.isinf(high[1])


def test_the_largest_k1_is_passive_with_the_margin_and_no_more():
    largest = largest_K1(DAMPED, B1, ALPHA)
    physical = {"K1": largest, "B1": B1, "alpha": ALPHA}
    np.testing.assert_allclose(minimum_damping(DAMPED, physical)[0], 0.95 * (1 - SEARCH_MARGIN), rtol=1e-12)
    passive = Mechanics(K_eff=0.44, damping=0.95)
    assert bool(allowed(passive, physical)[0])
    assert not bool(allowed(passive, physical | {"K1": largest * (1 + 1e-9)})[0])
    model = FOSLS(float(K0_of(passive, physical)[0]), float(largest[0]), B1[0], ALPHA[0])
    np.testing.assert_allclose(model.dc_gain(), 0.44, rtol=1e-12)


def test_a_set_outside_the_damping_range_is_refused():
    low, high = (end[0] for end in K1_range(DAMPED, B1, ALPHA))
    K1 = jnp.array([low * (1 - 1e-9), low, high, high * (1 + 1e-9)])
    physical = {"K1": K1, "B1": jnp.full(4, B1[0]), "alpha": jnp.full(4, ALPHA[0])}
    device = Mechanics(K_eff=0.44, damping=5.0, effective_damping=(10.0, 80.0))
    assert allowed(device, physical).tolist() == [False, True, True, False]


LATE = Mechanics(K_eff=0.44, damping=0.95, delay=271e-6)
BOX = (Parameter("K1", 1.0, 32.0, "N/mm"), Parameter("B1", 0.001, 32.0), Parameter("alpha", 0.01, 0.99))


def test_columns_end_where_a_late_set_is_passive_with_the_margin():
    shares = np.random.default_rng(0).random((32, 3))
    shares[::2, 0] = 1
    x = Columns(BOX, LATE).from_shares(jnp.asarray(shares))
    K1, B1, alpha = (p.to_physical(x[:, i]) for i, p in enumerate(BOX))
    physical = {"K1": K1, "B1": B1, "alpha": alpha}
    held = np.asarray(largest_K1(LATE, B1, alpha)) >= 1
    assert held.sum() > 16
    needed = np.asarray(minimum_damping(LATE, physical))
    np.testing.assert_array_equal(needed <= 0.95 * (1 - SEARCH_MARGIN), held)
    np.testing.assert_array_equal(allowed(LATE, physical), held)
    at_end = held & (shares[:, 0] == 1) & (np.asarray(K1) < 32)
    np.testing.assert_allclose(needed[at_end], 0.95 * (1 - SEARCH_MARGIN), rtol=2e-5)
    assert np.any(np.asarray(K1) * 1.01 < np.asarray(largest_K1(dataclasses.replace(LATE, delay=0.0), B1, alpha)))


def test_no_set_is_allowed_on_a_device_that_hardly_holds_the_spring():
    """A few K1 may be passive there, in no interval from 0 on."""
    physical = {"K1": np.array([0.05]), "B1": np.array([0.0033]), "alpha": np.array([0.379])}
    least = least_damping(0.44, 1e-3, 1e-3) / (1 - SEARCH_MARGIN)
    for damping, fine in ((0.99 * least, False), (1.01 * least, True)):
        late = Mechanics(K_eff=0.44, damping=damping, delay=1e-3)
        assert passivity.is_passive(*(value[0] for value in physical.values()), damping, delay=1e-3)
        assert allowed(late, physical).tolist() == [fine]
