"""Name and formula of a covariance function, as pages and the checklist print them."""

import numpy as np

from hilbo.kernels import RBF, Matern32, Stationary

__all__ = ["covariance_words", "formula"]

_NAMES: dict[type[Stationary], str] = {RBF: "squared-exponential", Matern32: "Matérn 3/2"}
_DISTANCE = "Σ θᵢ (xᵢ − xᵢ′)²"
_FORMS: dict[type[Stationary], str] = {RBF: f"exp(−{_DISTANCE})", Matern32: f"(1 + s) exp(−s), s² = 6 {_DISTANCE}"}


def covariance_words(kernel: Stationary) -> str:
    """Name of a kernel's family in running text: "squared-exponential" or "Matérn 3/2"."""
    return _NAMES[type(kernel)]


def formula(kernel: Stationary) -> str:
    """k(x, x′) of the normalised parameters as text, with the kernel's variance and thetas in four digits.

    For categorical coordinates the text adds that two different levels count as 1 apart.
    """
    thetas = np.ravel(np.asarray(kernel.theta))
    given = ", ".join(f"{theta:.4g}" for theta in thetas)
    levels = ", where two different levels of a parameter have the distance 1" if any(kernel.levels) else ""
    each = "every θᵢ" if kernel.theta.ndim == 0 else "θ"
    return f"k(x, x′) = {float(kernel.variance):.4g} · {_FORMS[type(kernel)]}, with {each} = {given}{levels}"
