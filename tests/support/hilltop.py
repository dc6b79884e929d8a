"""A hill, and its maximum over a search space."""

import equinox as eqx
import jax
import jax.numpy as jnp

from hilbo import acquisition
from hilbo.search.candidates import search_points

__all__ = ["height", "highest"]


def height(x, top, sharpness):
    return -jnp.sum(sharpness * (x - top) ** 2)


def highest(space, top, sharpness):
    """The maximum of a hill over a space, in the unit cube."""
    return _highest(space, jnp.asarray(search_points(space, 0, 64)), jnp.asarray(top), jnp.asarray(sharpness))


@eqx.filter_jit
def _highest(space, candidates, top, sharpness):
    values = jax.vmap(lambda x: height(x, top, sharpness))(candidates)
    return acquisition.maximise(values, candidates, lambda x: height(x, top, sharpness), **space.searched)
