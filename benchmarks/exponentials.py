"""Make the table of hilbo/mechanics/exponentials.py and measure its error; a minute.

    python benchmarks/exponentials.py [--degree 8] [--states 8 10 12]

For each order on Chebyshev nodes of [0, 1] the exponentials are fitted to the partial sums S_n, n <= 10,000, by
least squares in (S_n - sum)/(α(1 - α)·sqrt(S_n)); from one order to the next the last fit is the start. The values of
the polynomials at the nodes give their Chebyshev coefficients.
"""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

jax.config.update("jax_enable_x64", True)
from hilbo.mechanics.exponentials import decode  # noqa: E402

LONGEST = 10_000
SAMPLES = np.unique(np.round(np.concatenate([np.arange(40), np.geomspace(40, LONGEST, 200)])))


def partial_sums(alpha):
    return np.cumprod(np.concatenate([[1.0], 1 - alpha / np.arange(1, LONGEST + 1)]))[SAMPLES.astype(int)]


@jax.jit
def residual(q, alpha, exact):
    rates, logits = jnp.split(q, 2)
    weight, loss = decode(rates, logits, alpha)
    # 1 - λ_1 may pass 1 on the way to the solution, never in it.
    approximation = 1 + weight @ jnp.where(
        SAMPLES[None, :] == 0, 0.0, jnp.abs(1 - loss[:, None]) ** SAMPLES[None, :] * jnp.sign(1 - loss[:, None]) - 1
    )
    return (approximation - exact) / (alpha * (1 - alpha) * jnp.sqrt(exact))


slope = jax.jit(jax.jacfwd(residual))


def fit(alpha, start, reach=1.0):
    exact = partial_sums(alpha)
    near = (start - reach, start + reach)
    tight = {"xtol": 1e-15, "ftol": 1e-15, "gtol": 1e-15, "max_nfev": 2000}
    solution = least_squares(residual, start, slope, args=(alpha, exact), bounds=near, x_scale="jac", **tight)
    return solution.x, np.abs(solution.fun).max()


def first(states):
    return np.concatenate([np.linspace(1, np.log(2 / LONGEST), states)[1:], np.linspace(0, -1, states)[1:]])


def in_order(q, alpha):
    """The same exponentials with the fastest first: any order solves the problem, one of them is smooth in α."""
    weight, loss = map(np.asarray, decode(*jnp.split(q, 2), jnp.asarray(alpha)))
    order = np.argsort(-loss)
    weight, rate = weight[order], -np.log1p(-loss[order])
    ends = np.array([alpha, *[alpha * (1 - alpha)] * (len(weight) - 2), 1 - alpha])
    logit, rate[-1] = np.log(weight / ends), rate[-1] / alpha
    return np.concatenate([np.log(rate[1:]), logit[1:] - logit[0]])


def table(states, degree):
    nodes = (1 + np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))) / 2
    values = np.zeros((degree + 1, 2 * states - 2))
    middle, first_error = fit(0.5, in_order(fit(0.5, first(states), 5.0)[0], 0.5))
    for side in (nodes[nodes >= 0.5][::-1], nodes[nodes < 0.5]):
        q, last, worst = middle, 0.5, first_error
        for alpha in side:
            for step in np.linspace(last, alpha, 1 + int(np.ceil(abs(alpha - last) / 0.02)))[1:]:
                q, worst = fit(step, q)
            last = alpha
            values[nodes == alpha] = q
            print(f"  α = {alpha:.4f}: {worst:.2e}", np.round(q[: states - 1], 2))
    return np.polynomial.chebyshev.chebfit(2 * nodes - 1, values, degree).T


def error(coefficients, alpha):
    q = np.polynomial.chebyshev.chebval(2 * alpha - 1, coefficients.T)
    weight, loss = map(np.asarray, decode(*jnp.split(jnp.asarray(q), 2), jnp.asarray(alpha)))
    return np.abs(residual(q, alpha, partial_sums(alpha))).max(), weight.min(), loss.min(), loss.max()


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--degree", type=int, default=8)
    options.add_argument("--states", type=int, nargs="*", default=[8, 10, 12])
    chosen = options.parse_args()
    for states in chosen.states:
        coefficients = np.round(table(states, chosen.degree), 6)
        for alpha in (1e-6, 0.001, 0.01, 0.03, 0.1, 0.25, 0.5, 0.75, 0.9, 0.97, 0.99, 0.999, 1 - 1e-6):
            print(states, alpha, *(f"{x:.3e}" for x in error(coefficients, alpha)))
        for row in coefficients:
            print("        (" + ", ".join(f"{x:.6f}" for x in row) + "),")


if __name__ == "__main__":
    main()
