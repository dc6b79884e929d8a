"""Passivity of a rendering whose force is delayed: the damping needed at each frequency.

Between the sample of the position and its force lies a delay τ, 0 <= τ <= T; then the force is constant for T. With σ =
τ/T, θ = ωT and φ as in `passivity_certificate`, the rendering needs the damping (T/2)·Y(θ) at each frequency,

    Y = (ψ + sqrt(ψ² + 4σ(1 - σ)|H|²))/2,   ψ = φ + 2σ·Re(e^{-jθ}·H)

Derivation. A motion with velocities v_k at the aliases ω_k = (θ + 2πk)/T of one frequency dissipates the energy
b·Σ|v_k|² - Re v*xy*v in damping and rendering, x_k = (1 - e^{-jθ})·H·e^{-jω_kτ}/(T·ω_k) and y_k = 1/ω_k. The Hermitian
part of xy* has the largest eigenvalue (Re y*x + sqrt(|x|²|y|² - (Im y*x)²))/2, and with z = 1 - e^{-jθ}

    Σ_k e^{-jω_kτ}/ω_k² = T²·(1 - σz)/|z|²,   0 <= τ <= T.

In time: the path from x_n to x_{n+1} that loses least in the damping has a bend where the force changes, and absorbs
(F_n - σΔF_n)·Δx_n + b·Δx_n²/T - σ(1 - σ)T·ΔF_n²/(4b), ΔF_n = F_n - F_{n-1}; see `witness`. At σ = 0 this is the
criterion of Colgate and Schenkel (1997), J. Robotic Syst. 14, 37-47.

As a function of K1, with K0 set by H(1) = K_eff, the largest Y starts at that of the spring K_eff alone, in slow
motion,

    Y = K_eff·(1 + 2σ + sqrt(1 + 8σ))/2,

and may fall before it rises, or rise by up to 4 % and fall. Beyond 1.05 times the spring's value it only rises
(numerical evidence, docs/methods/mechanics.md), so that the passive K1 of a device with more damping than that are an
interval from 0. With less damping they need not be an interval: `least_damping`.

Units: K N/mm, T and delay s, damping N·s/m.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

from hilbo.errors import InputError
from hilbo.numerics.host import namespace_of
from hilbo.numerics.shown import concrete, shown

__all__ = ["check_delay", "clear_of_spring", "larger_root", "least_damping"]

_CLEAR = 1.05  # of the largest Y of a spring


def check_delay(delay: Any, T: Any) -> bool:
    """Whether the force is delayed: `delay` (s) is above 0 anywhere, or traced by JAX.

    Raises `InputError` for a known delay outside 0 to T (s).
    """
    if not concrete(delay):
        return True
    given = np.asarray(delay, float)
    most = np.asarray(T, float) if concrete(T) else math.inf
    if not np.all(fine := (given >= 0) & (given <= most) & np.isfinite(given)):
        wrong = np.broadcast_to(given, np.shape(fine))[~fine][0]
        raise InputError(f"delay is {shown(wrong)} s; it must be from 0 to the sampling time T, in s.")
    return bool(np.any(given > 0))


def larger_root(psi: Float[Any, "*a"], product: Float[Any, "*a"]) -> Float[Any, "*a"]:
    """Non-negative root of Y² - psi·Y - product = 0 for `product` >= 0, without cancellation for psi < 0."""
    xp = namespace_of(psi, product)
    root, rising = xp.sqrt(psi**2 + 4 * product), psi >= 0
    return xp.where(rising, (psi + root) / 2, 2 * product / xp.where(rising, 1, root - psi))


def least_damping(K_eff: Any, T: Any, delay: Any) -> Any:
    """Device damping (N·s/m) below which `delayed_bounds.delayed_largest_K1` is 0, for every B1 and α."""
    return 500 * T * clear_of_spring(K_eff, delay / T)


def clear_of_spring(K_eff: Any, lag: Any) -> Any:
    """1.05 times the largest Y (N/mm) of the spring K_eff alone; beyond that, the largest Y only rises with K1.

    `lag` is σ = delay/T.
    """
    return _CLEAR * K_eff * (1 + 2 * lag + (1 + 8 * lag) ** 0.5) / 2
