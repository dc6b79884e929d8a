"""Models of modulus data: relaxation G(t) and creep compliance J(t), in closed form without a recorded input.

FO-SLS, with z = κ·(t/t0)^α, κ = K1·t0^α/B1, K_inst = K0 + K1, K_eff = K0 and ΔK = K1:

    G(t) = K_eff + ΔK·E_α(-z)
    J(t) = 1/K_inst + ΔK/K_inst²·z·E_{α,1+α}(-z·K_eff/K_inst)

Fractional Maxwell model, a spring-pot V (order α) in series with a spring-pot G (order β), 0 <= β < α <= 1:

    G(t) = G_c·(t/τ)^{-β}·E_{α-β,1-β}(-(t/τ)^{α-β}),  τ = (V/G)^{1/(α-β)},  G_c = V·τ^{-α}

The FO-SLS can be rendered; the fractional Maxwell model is for comparison only. t0 is the middle of the data on a log
scale, so that κ and α are determined in the range of the data. Units: t in s; moduli keep their own unit. Reference:
Bonfanti, Kaplan, Charras & Kabla (2020), Soft Matter 16:6002 (fractional models and their moduli).
"""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hilbo.identification.fitting import Curve, Test
from hilbo.numerics.mittag_leffler import mittag_leffler, mittag_leffler_increment, mittag_leffler_two

__all__ = ["Continuous", "FractionalMaxwell"]

Weights = Literal["range", "relative"]


class Continuous(eqx.Module):
    """FO-SLS in continuous time; q = (K_inst, K_eff, log κ, logit α).

    `weights`: divide residuals by the curve's range ("range") or by each value ("relative").
    """

    weights: Weights = eqx.field(static=True, default="range")
    reference: Float[Array, ""] | float = 1.0  # t0, s

    labels = ("K_inst", "K_eff", "kappa", "alpha")
    kinds = ("modulus", "compliance")

    def physical(self) -> tuple[tuple[bool, ...], tuple[bool, ...]]:
        """Masks of the lower and of the upper bounds that are physical limits: of them all only K_eff = 0."""
        return (False, True, False, False), (False,) * 4

    def at(self, tests: Sequence[Test]) -> "Continuous":
        """Copy of the model with the reference time t0 at the geometric middle of the tests' times."""
        times = np.concatenate([test.time for test in tests])
        return Continuous(self.weights, jnp.asarray(np.sqrt(times.min() * times.max())))

    def box(self, tests: Sequence[Test]) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of q: moduli up to 50 times the largest, κ from 1e-5 to 1e5, α from 0.01 to 0.99.

        Two arrays (4,).
        """
        (_, top), ends = _extremes(tests), np.log(0.99 / 0.01)
        return np.array([1e-3 * top, 0.0, np.log(1e-5), -ends]), np.array([50 * top, 50 * top, np.log(1e5), ends])

    def starts(self, tests: Sequence[Test]) -> Float[np.ndarray, "starts 4"]:
        """Five starting points, from weak and broad to strong and narrow relaxation. (5, 4)."""
        last, top = _extremes(tests)
        pairs = [(1.0, 0.2), (1.0, 0.4), (1.0, 0.7), (0.1, 0.5), (10.0, 0.5)]
        return np.array([[1.2 * top, 0.5 * last, np.log(kappa), np.log(a / (1 - a))] for kappa, a in pairs])

    def prepare(self, test: Test) -> Curve:
        """Convert a test of moduli to a `Curve` with the outputs of all repeats. `scale` is the range of their mean, at
        every time; for weights "relative" it is that mean itself. Nothing is checked."""
        return _prepare(test, self.weights)

    def predict(self, q: Float[Array, " 4"], curve: Curve, weights: Float[Array, " R"]) -> Float[Array, " m"]:
        """G(t) or J(t) at the measured times, by the kind of the curve. `q` (4,) -> (m,), in the unit of the table.

        `weights` are not used: the prediction does not depend on the repeats.
        """
        del weights
        alpha, change = jax.nn.sigmoid(q[3]), q[0] - q[1]
        z = jnp.exp(q[2]) * (curve.time / self.reference) ** alpha
        if curve.kind == "modulus":
            return q[1] + change * mittag_leffler(alpha, z)
        return 1 / q[0] + change / q[0] ** 2 * z * mittag_leffler_increment(alpha, z * q[1] / q[0])

    def natural(self, q: Float[Array, " 4"]) -> Float[Array, " 4"]:
        """Coordinates converted to the units of their labels: K_inst, K_eff, κ and α. (4,) -> (4,)."""
        return jnp.stack([q[0], q[1], jnp.exp(q[2]), jax.nn.sigmoid(q[3])])

    def parameters(self, q: Float[Array, " 4"]) -> dict[str, Float[Array, ""]]:
        """K0, K1, B1 (unit·s^α), α, K_inst and K_eff by name, from `q` (4,)."""
        alpha, K1 = jax.nn.sigmoid(q[3]), q[0] - q[1]
        B1 = K1 * self.reference**alpha * jnp.exp(-q[2])
        return {"K0": q[1], "K1": K1, "B1": B1, "alpha": alpha, "K_inst": q[0], "K_eff": q[1]}


class FractionalMaxwell(eqx.Module):
    """Fractional Maxwell model, two spring-pots in series, for relaxation moduli; q = (log G_c, log τ, α, β/α)."""

    weights: Weights = eqx.field(static=True, default="relative")

    labels = ("G_c", "tau", "alpha", "beta/alpha")
    kinds = ("modulus",)

    def physical(self) -> tuple[tuple[bool, ...], tuple[bool, ...]]:
        """Masks of the lower and of the upper bounds that are physical limits: β >= 0 and α <= 1."""
        return (False, False, False, True), (False, False, True, False)

    def at(self, tests: Sequence[Test]) -> "FractionalMaxwell":
        """The model itself, unchanged: it has no reference time."""
        del tests
        return self

    def box(self, tests: Sequence[Test]) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of q: τ far beyond the data on both sides, α from 0.1 to 1, β up to 0.9 α.

        Two arrays (4,).
        """
        first, last = min(test.time[0] for test in tests), max(test.time[-1] for test in tests)
        top = np.log(_extremes(tests)[1])
        lower = [top - 25, np.log(first) - 10, 0.1, 0.0]
        return np.array(lower), np.array([top + 10, np.log(last) + 20, 1.0, 0.9])

    def starts(self, tests: Sequence[Test]) -> Float[np.ndarray, "starts 4"]:
        """Five starting points, from narrow to broad relaxation. (5, 4)."""
        times = np.concatenate([test.time for test in tests])
        middle, top = 0.5 * np.log(times.min() * times.max()), np.log(_extremes(tests)[1])
        shapes = [(0.0, 0.5, 0.2), (3.0, 0.7, 0.2), (3.0, 0.9, 0.1), (6.0, 0.5, 0.5), (-3.0, 0.3, 0.2)]
        return np.array([[top - 1, middle + later, alpha, ratio] for later, alpha, ratio in shapes])

    def prepare(self, test: Test) -> Curve:
        """Convert a test of moduli to a `Curve`, with the scale of its residuals by `weights`."""
        return _prepare(test, self.weights)

    def predict(self, q: Float[Array, " 4"], curve: Curve, weights: Float[Array, " R"]) -> Float[Array, " m"]:
        """G(t) at the measured times. `q` (4,) -> (m,), in the unit of the table.

        `weights` are not used: the prediction does not depend on the repeats.
        """
        del weights
        beta = q[2] * q[3]
        log_time = jnp.log(curve.time) - q[1]
        shape = mittag_leffler_two(q[2] - beta, 1 - beta, jnp.exp((q[2] - beta) * log_time))
        return jnp.exp(q[0] - beta * log_time) * shape

    def natural(self, q: Float[Array, " 4"]) -> Float[Array, " 4"]:
        """Coordinates converted to the units of their labels: G_c, τ (s), α and β/α. (4,) -> (4,)."""
        return jnp.stack([jnp.exp(q[0]), jnp.exp(q[1]), q[2], q[3]])

    def parameters(self, q: Float[Array, " 4"]) -> dict[str, Float[Array, ""]]:
        """G (unit·s^β), V (unit·s^α), α and β by name, from `q` (4,)."""
        alpha, beta = q[2], q[2] * q[3]
        return {"G": jnp.exp(q[0] + beta * q[1]), "V": jnp.exp(q[0] + alpha * q[1]), "alpha": alpha, "beta": beta}


def _prepare(test: Test, weights: Weights) -> Curve:
    """Curve of a modulus test; residuals are scaled by its range, or by each value for weights "relative"."""
    mean = test.output.mean(axis=0)
    scale = mean if weights == "relative" else np.full(mean.size, np.ptp(mean))
    zero = jnp.zeros(test.repeats, scale.dtype)
    return Curve(test.kind, jnp.asarray(test.time), jnp.asarray(test.output), zero, jnp.asarray(scale))


def _extremes(tests: Sequence[Test]) -> tuple[float, float]:
    """Smallest and largest modulus of the data, over the means of the repeats; of a compliance its reciprocal."""
    means = [test.output.mean(axis=0) for test in tests]
    moduli = [mean if test.kind == "modulus" else 1 / mean for test, mean in zip(tests, means, strict=True)]
    return float(min(values.min() for values in moduli)), float(max(values.max() for values in moduli))
