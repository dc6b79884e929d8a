"""What this machine needs for the operations alone: what the tasks of benchmarks/run.py cannot do without.

Imported after the number of cores has been limited.
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from run_tasks import once

from hilbo.hyperparameters.maximum_evidence import maximise_evidence
from hilbo.likelihoods import OrdinalTerms
from hilbo.numerics.linalg import cholesky, solve_lower
from hilbo.ordinal_gp import Trials, fit


def floors(rounds, scene):
    """Seconds per operation of this machine through XLA, and how many steps the tasks take on `run_tasks.data()`."""
    return operations(rounds) | parts(rounds, scene) | counts(scene)


def operations(rounds):
    """Seconds of an exponential, of a multiplication with addition, and of a call that does nothing."""
    numbers = {}
    for kind in ("float32", "float64"):
        pairs = -jnp.linspace(0.0, 20.0, 25 * 5000, dtype=kind).reshape(25, 5000)
        thin, square = jnp.ones((26, 25), kind), jnp.ones((600, 600), kind)
        wide = jnp.ones((600, 2000), kind)
        exp, product = jax.jit(jnp.exp), jax.jit(jnp.matmul)
        for name, call, count in (
            ("exp", partial(exp, pairs), pairs.size),
            ("product 26 x 25 x 5,000", partial(product, thin, pairs), 26 * 25 * 5000),
            ("product 600 x 600 x 2,000", partial(product, square, wide), 600 * 600 * 2000),
        ):
            once(call)
            numbers[f"{name}, {kind}"] = min(once(call) for _ in range(4 * rounds)) / count
    nothing = jax.jit(lambda a: a + 1)
    one = jnp.ones(())
    once(lambda: nothing(one))
    numbers["dispatch"] = min(once(lambda: nothing(one)) for _ in range(40 * rounds))
    return numbers


def parts(rounds, scene):
    """Seconds of what a fit consists of, within a compiled loop."""
    study, _, _, _, first, _ = scene
    terms = OrdinalTerms(study.gp.likelihood, first.q, first.mask)
    numbers = {}
    for n, repeats in ((25, 300), (600, 3)):
        places = jnp.linspace(0.0, 1.0, n)
        matrix = jnp.exp(-30.0 * (places[:, None] - places[None, :]) ** 2) + jnp.eye(n)
        column, lower = jnp.ones((n, 1)), jnp.linalg.cholesky(matrix)
        for name, body, start in (
            ("factor", lambda m, k=matrix: 1e-3 * cholesky(m) + k, matrix),
            ("solve", lambda c, f=lower: 1e-3 * solve_lower(f, c) + 1.0, column),
            ("solves", lambda m, f=lower, k=matrix: 1e-3 * solve_lower(f, m) + k, matrix),
            ("product", lambda m, k=matrix: 1e-3 * (k @ m) + k, matrix),
        ):
            numbers[f"{name} {n}"] = within(body, start, repeats, rounds)
    numbers["terms 25"] = within(lambda e: 0.9 * e + 1e-9 * sum(terms(e)), jnp.linspace(-1.0, 1.0, 25), 300, rounds)
    return numbers


def within(body, start, repeats, rounds):
    """Seconds a turn of `body` takes in a compiled loop of `repeats` turns that begins with `start`."""
    many = jax.jit(lambda x: jax.lax.fori_loop(0, repeats, lambda _, value: body(value), x))
    once(lambda: many(start))
    return min(once(lambda: many(start)) for _ in range(2 * rounds)) / repeats


def counts(scene):
    """Newton steps of the fits, and evaluations of the search for hyperparameters, as many for each start as for the
    best."""
    study, _, _, people, first, trials = scene
    pooled = Trials.from_arrays(*(np.concatenate(part) for part in zip(*people, strict=True)), 600)

    def evaluations(inference):
        def learn(one):
            return maximise_evidence(study.gp, one, starts=4, inference=inference).steps

        return 4 * int(np.sum(eqx.filter_jit(jax.vmap(learn))(trials)))

    steps = int(fit(study.gp, pooled).certificate.iterations)
    return {
        "steps 25": int(fit(study.gp, first).certificate.iterations),
        "steps 600": steps,
        # EP counts the steps to Laplace's mode, where it begins, with its own.
        "steps 600, ep": int(fit(study.gp, pooled, inference="ep").certificate.iterations) - (steps - 1),
        "evaluations": evaluations("laplace"),
        "evaluations, ep": evaluations("ep"),
    }
