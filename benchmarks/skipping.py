"""Computations that hilbo skips, with the saving and the loss of accuracy; --write: into docs/results/run_time.md.

    python benchmarks/skipping.py --write

The state is one person's 25 answers of benchmarks/run.py, the points its 20,000; one core. With and without take turns,
the fastest of the rounds; errors are measured over all points, in units of the prior's sd, 1.
"""

import argparse

import numpy as np
import run
from pages import put

HEAD = """\
Made by `python benchmarks/skipping.py --write`, on one core: the fastest of {rounds} rounds, with and without the skip
in turn. Errors are the largest over all points, in units of the prior's sd. "Bound" is what the code guarantees.

| skip | without (us) | with (us) | saves | error | bound | tested by |
|---|---:|---:|---:|---:|---|---|
"""


def tasks():
    """(name, without, with, error, bound, test)."""
    import jax
    import jax.numpy as jnp
    from run_tasks import data

    from hilbo.acquisition import UCB
    from hilbo.kernels import gram
    from hilbo.laplace import _whitened_mode, plain_mode
    from hilbo.likelihoods import OrdinalTerms
    from hilbo.ordinal_gp import fit
    from hilbo.search import lattice
    from hilbo.search.space_lattice import lattice_of

    study, candidates, _, _, one, trials = data()
    points, score = jnp.asarray(candidates), UCB(0.7)
    posterior = jax.jit(lambda data: fit(study.gp, data, throw=False))(one)
    short, short_points = posterior.astype(jnp.float32), points.astype(jnp.float32)
    lattice_ = lattice_of(study.space, 25)
    usable = np.concatenate([lattice_.inside, lattice_.present])
    grid = lattice_.points(*map(jnp.asarray, np.indices(usable.shape)))[jnp.asarray(usable)]
    grid = jnp.concatenate([grid, lattice_.extra]).astype(jnp.float32)

    def known(p):
        return p.gp.kernel, p.trials.x, p.latent.weights, p.latent.factor

    everywhere = jax.jit(lambda p, x: score(*p.predict(x)))
    few = jax.jit(lambda p, x: lattice.screen_points(*known(p), x, score))
    columns = jax.jit(lambda p: lattice.screen(*known(p), lattice_, score).value)
    all_values = everywhere(posterior, points)
    terms = OrdinalTerms(study.gp.likelihood, one.q, one.mask)
    covariance = gram(study.gp.kernel, one.x, one.x)
    zeros = jnp.zeros(25)
    plain = jax.jit(lambda k, start: plain_mode(terms, k, start, 20))
    whitened = jax.jit(lambda k, start: _whitened_mode(terms, k, start, 200))
    before = jax.jit(lambda data: fit(study.gp, data, throw=False))(one.first(24)).latent.weights
    cold_mode, warm_mode = plain(covariance, zeros), plain(covariance, before)
    shares = far_shares(study, trials, points)
    mean, whole = jax.jit(lambda p, x: p.mean(x)), jax.jit(lambda p, x: p.predict(x))
    box = jnp.asarray(np.random.default_rng(0).random((int(20_000 / study.space.volume()), 3)))
    rows = [
        (
            "variance not required: 20,000 means",
            lambda: whole(posterior, points),
            lambda: mean(posterior, points),
            gap(whole(posterior, points)[0], mean(posterior, points)),
            "rounding",
            "test_ordinal_gp",
        ),
        (
            "no variance where it cannot win: best of 20,000, float32",
            lambda: everywhere(short, short_points),
            lambda: few(short, short_points),
            abs(float(jnp.max(everywhere(short, short_points)) - jnp.max(few(short, short_points)))),
            "0: same argmax",
            "test_lattice",
        ),
        (
            "only the passive set: a box with 20,000 passive points",
            lambda: everywhere(posterior, box),
            lambda: everywhere(posterior, points),
            0.0,
            "0",
            "test_search_space",
        ),
        (
            f"separable kernel: {len(grid):,} points of the lattice, float32",
            lambda: everywhere(short, grid),
            lambda: columns(short),
            abs(float(jnp.max(everywhere(short, grid)) - columns(short))),
            "rounding: same maximum",
            "test_lattice",
        ),
        (
            "float32 screening of 20,000 points",
            lambda: everywhere(posterior, points),
            lambda: everywhere(short, short_points),
            gap(all_values, everywhere(short, short_points)),
            "1e-5; scored again in float64",
            "test_lattice",
        ),
        (
            "no root of the covariance: the mode of 25 answers",
            lambda: whitened(covariance, zeros),
            lambda: plain(covariance, zeros),
            gap(whitened(covariance, zeros).eta, cold_mode.eta),
            "the certificate's residual",
            "test_laplace",
        ),
        (
            "warm start from 24 answers (not used)",
            lambda: plain(covariance, zeros),
            lambda: plain(covariance, before),
            gap(cold_mode.eta, warm_mode.eta),
            "the certificate's residual",
            "test_ordinal_gp",
        ),
    ]
    notes = [
        "",
        "Without benefit, and not implemented:",
        "",
        f"- Warm starts: {int(warm_mode.steps)} steps in place of {int(cold_mode.steps)}; the bits of the next point"
        " would depend on the path to this state, and a log could not be replayed from its responses alone.",
        "- Appended updates: all curvatures change with a response, so that the Newton matrix must be factorised again,"
        " and the search needs no root of the covariance that could be updated.",
        "- Participants who cannot move a query: the covariance with each of the 25 responses is below 1e-3 for"
        f" {100 * shares[0]:.1f} % of the (participant, point) pairs, below 1e-6 for {100 * shares[1]:.1f} %; finding"
        " these pairs requires the same exponentials.",
    ]
    return rows, notes


def far_shares(study, trials, points):
    """Shares of (person, point) pairs in which no answer has a covariance above 1e-3, and above 1e-6."""
    import jax
    import jax.numpy as jnp

    from hilbo.kernels import gram

    nearest = jax.jit(jax.vmap(lambda x: jnp.max(gram(study.gp.kernel, x, points), axis=0)))(trials.x)
    return float(jnp.mean(nearest < 1e-3)), float(jnp.mean(nearest < 1e-6))


def gap(left, right):
    return float(np.max(np.abs(np.asarray(left, float) - np.asarray(right, float))))


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--rounds", type=int, default=50)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    run.limit_cores(1)
    from run_tasks import once

    rows, notes = tasks()
    lines = []
    for name, without, with_it, error, bound, test in rows:
        for function in (without, with_it):
            once(function)
        times = [[once(f) for f in (without, with_it)] for _ in range(chosen.rounds)]
        a, b = 1e6 * np.min(times, axis=0)
        lines.append(f"| {name} | {a:.0f} | {b:.0f} | {100 * (1 - b / a):.0f} % | {error:.0e} | {bound} | {test} |")
    text = HEAD.format(rounds=chosen.rounds) + "\n".join([*lines, *notes]) + "\n"
    print(text)
    if chosen.write:
        put("results/run_time.md", "skipping", text)


if __name__ == "__main__":
    main()
