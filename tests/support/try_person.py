"""A scripted person of `hilbo try`, who presses, lets go, and compares the two displacement curves."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from hilbo import viscoelastic
from hilbo.app.server.tried import FIXED, NAMES

__all__ = ["Person"]

_SEEN = 0.1  # mm that are seen at all: below, differences say nothing
_PRESS = 3.0 * np.interp(np.arange(0, 4, FIXED["T"]), [0, 0.1, 2, 2.1], [0, 1, 1, 0])  # N: 2 s, and 2 s of recovery


@jax.jit
def _curve(K1, B1, alpha):
    model = viscoelastic.FOSLS(FIXED["K0"], K1, B1, alpha, T=FIXED["T"], memory="full")
    return jnp.log(_SEEN + model.simulate_force(_PRESS))


class Person:
    """Answers by how many times deeper one surface is than the other, root mean square over the time."""

    def __init__(self, reference: Mapping[str, float], close: float = 0.15, similar: float = 0.5):
        self._reference = _curve(*(reference[name] for name in NAMES))
        self._steps = (("close", close), ("similar", similar))

    def distance(self, values: Mapping[str, float]) -> float:
        """From the reference, in natural logarithms: 0.1 is a tenth deeper or less deep."""
        curve = _curve(*(values[name] for name in NAMES))
        return float(jnp.sqrt(jnp.mean((curve - self._reference) ** 2)))

    def __call__(self, values: Mapping[str, float]) -> str:
        distance = self.distance(values)
        return next((label for label, most in self._steps if distance < most), "different")
