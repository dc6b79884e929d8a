"""Which K1 a device and a range of effective damping leave: ends that the model itself confirms."""

import jax.numpy as jnp
import numpy as np

from hilbo.search.box import Mechanics
from hilbo.search.feasibility import SEARCH_MARGIN, K0_of, K1_range, allowed, largest_K1, minimum_damping
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
