"""Searches from several starts: what one search leaves for the next."""

import jax.numpy as jnp
import numpy as np

from hilbo.numerics.climbing import climb


def test_the_end_of_a_search_from_an_unusable_start_stops_no_other_one():
    """A search near the end of an earlier one stops there; of one whose result does not count, it must not."""
    mode = jnp.array([0.43, 0.61])
    starts = jnp.array([[0.1, 0.2], [0.8, 0.9]])
    found = climb(
        starts,
        jnp.array([False, True]),
        lambda x: -jnp.sum(jnp.abs(x - mode) ** 2.5),  # no Newton step reaches it at once
        from_box=lambda w: w,
        to_box=lambda x: x,
        feasible=lambda x: jnp.asarray(True),
    )
    assert found.candidate == 1
    np.testing.assert_allclose(found.x, mode, atol=1e-4)
