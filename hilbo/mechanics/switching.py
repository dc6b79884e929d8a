"""Change of the parameter set while the device is in contact.

The history of one set is no valid history of another: clearing it makes the force jump by newtons, and rescaling it is
wrong in motion. So the new set runs a separate history on the same positions from the moment it is staged; once that
is filled, the force switches to it, with the difference d of the two forces added and then reduced at a bounded rate:

    F_n = F_old,n                                          n < flip
    F_n = F_new,n + sign(d)·max(|d| - slew·T·(n - flip), 0)    n >= flip,  d = F_old - F_new at the flip

The passivity conditions cover no switch: where possible, switch out of contact, with a cleared history. Units: mm, N,
slew N/s.
"""

import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Real

from hilbo.errors import InputError
from hilbo.mechanics.fosls import FOSLS

__all__ = ["switched_force"]


def switched_force(
    old: FOSLS, new: FOSLS, x: Real[ArrayLike, " n"], *, staged: int, flip: int, slew: float
) -> Float[Array, " n"]:
    """Force (N) along positions `x` (mm) when `new` is staged at sample `staged` and takes over at sample `flip`.

    At `flip` the difference of the two forces is added to the new one and then reduced by `slew` (N/s). The new history
    starts as if x[staged] had been constant for ever. Raises InputError for samples out of order or of range, a `slew`
    that is not above 0, and sets for different sampling times. `x` (n,) -> (n,).
    """
    x = jnp.asarray(x, old.K0.dtype)
    if not 0 <= staged <= flip < x.shape[0]:
        raise InputError(f"staged is {staged} and flip {flip}, they must be in this order within {x.shape[0]} samples.")
    if not slew > 0:
        raise InputError(f"slew is {slew} N/s; it must be above 0.")
    if old.T != new.T:
        raise InputError(f"The two sets are for T = {old.T} s and T = {new.T} s, they must be for the same T.")
    before = old.simulate(x)
    after = new.simulate(x[staged:], start="equilibrium")
    jump = before[flip] - after[flip - staged]
    left = jnp.maximum(jnp.abs(jump) - slew * new.T * jnp.arange(x.shape[0] - flip, dtype=x.dtype), 0)
    return jnp.concatenate([before[:flip], after[flip - staged :] + jnp.sign(jump) * left])
