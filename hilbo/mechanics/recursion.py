"""Recursion of the FO-SLS history: y_n = a·u_n + ρ·s_n, where s_n is the contribution of the past of y.

Position and force drive the FO-SLS through the same recursion, with different a and ρ (see `viscoelastic`). With c_0 =
1

    short memory:  s_n = Σ_{i=1..N} |c_i|·y_{n-i}                          state: the last N values of y
    full memory:   s_n = Σ_k p_k·m_k,  m_k <- λ_k·m_k + (1 - λ_k)·y_{n-1}  state: one fading mean for each exponential

Both are linear, so that m samples are two matrix products: with the impulse response d of 1/(1 - ρ·Σ|c_i|z^{-i}), its
lower triangular Toeplitz matrix D, and the rows M that propagate the state at the start of a block to each sample,

    s = D·M·state + (D - 1)/ρ · a·u,

in which every term is positive where a, ρ and u are. That is the same sum in another order, many times faster than
sample by sample, which is the recursion that a device runs (m = 1).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hilbo.mechanics.exponentials import exponentials
from hilbo.mechanics.memory import gl_coefficients
from hilbo.mechanics.ranges import Scalar
from hilbo.mechanics.span import Span

__all__ = ["BLOCK", "past_of"]

BLOCK = 32
"""Samples per block."""


class _History(NamedTuple):
    """Block form of a memory whose state has s numbers, for blocks of m samples."""

    taps: Float[Array, " m"]  # |c_1| … |c_m|
    carry: Float[Array, "m s"]  # contribution of the state to each sample
    write: Callable[[Array, Array], Array]  # the next state, from the state and y of the block
    state: Float[Array, " s"]  # before the first block


def past_of(
    alpha: Scalar, gain: Scalar, feedback: Scalar, u: Float[Array, " n"], before: Scalar, span: Span, block: int = BLOCK
) -> Float[Array, " n"]:
    """Contribution s_n of the past at every sample, for a history y that has been `before` since -∞. `u` (n,) -> (n,).

    `gain` is a, `feedback` is ρ. `block` affects only speed and rounding; 1 is the plain recursion.
    """
    blocks = -(-u.shape[0] // block)
    driven = gain * jnp.zeros(blocks * block, u.dtype).at[: u.shape[0]].set(u).reshape(blocks, block)
    describe = _taps if span.memory == "short" else _means
    history = describe(alpha, before, span, block)
    impulse, echo = _impulse(history.taps, feedback)
    carry = _toeplitz(impulse) @ history.carry

    def advance(state, inputs):
        echoed, driven = inputs
        past = carry @ state + echoed
        return history.write(state, driven + feedback * past), past

    _, past = jax.lax.scan(advance, history.state, (driven @ _toeplitz(echo).T, driven))
    return past.reshape(-1)[: u.shape[0]]


def _taps(alpha: Scalar, before: Scalar, span: Span, block: int) -> _History:
    """Block form of short memory: the state is the last values of y, the newest last, all `before` at the start."""
    N, length = span.N, max(span.N, block)
    taps = jnp.zeros(length + block, alpha.dtype).at[:N].set(-gl_coefficients(alpha, N)[1:])
    delay = jnp.arange(block)[:, None] + length - jnp.arange(length)[None, :]

    def write(state, y):
        return jnp.concatenate([state[block:], y])

    return _History(taps[:block], taps[delay - 1], write, jnp.full(length, before))


def _means(alpha: Scalar, before: Scalar, span: Span, block: int) -> _History:
    """History of full memory in blocks, with `span.states` exponentials: |c_i| = Σ p_k (1 - λ_k) λ_k^{i-1} (`taps`),
    and the `carry` p_k λ_k^j of a block's samples. The state is one fading mean for each exponential, all `before` at
    the start; `write` advances them by a block."""
    weight, loss = exponentials(alpha, span.states)
    # As products, which have derivatives at λ = 0.
    powers = jnp.cumprod(jnp.concatenate([jnp.ones_like(loss)[None], jnp.tile(1 - loss, (block - 1, 1))]), axis=0)
    carry, entry = weight[None, :] * powers, loss[:, None] * powers[::-1].T
    decay = jnp.sum(entry, axis=1)  # 1 - λ^m, with all its digits where λ is close to 1

    def write(state, y):
        return state + (entry @ y - decay * state)

    return _History(carry @ loss, carry, write, jnp.full(span.states, before))


def _impulse(taps: Float[Array, " m"], feedback: Scalar) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Impulse response d_0 … d_{m-1}, and (d - 1)/ρ = Σ |c_i| d_{j-i}, the response of s to an input; (m,) each.

    `taps`: |c_1| … |c_m|.
    """

    def add(backwards, _):
        echo = taps @ backwards
        now = feedback * echo
        return jnp.concatenate([now[None], backwards[:-1]]), (now, echo)

    start = jnp.zeros_like(taps).at[0].set(1)
    _, (later, echo) = jax.lax.scan(add, start, length=taps.shape[0] - 1)
    return jnp.concatenate([jnp.ones_like(taps[:1]), later]), jnp.concatenate([jnp.zeros_like(taps[:1]), echo])


def _toeplitz(column: Float[Array, " m"]) -> Float[Array, "m m"]:
    """Lower triangular Toeplitz matrix with this first column."""
    size = column.shape[0]
    delay = jnp.arange(size)[:, None] - jnp.arange(size)[None, :]
    return jnp.where(delay >= 0, column[jnp.maximum(delay, 0)], 0)
