"""The closed expansions of the evidence against differentiation through the fit, and starts that lead nowhere.

All hyperparameters at once, so that tests share one program for each inference; the scale of the model is free then,
which a search would mind and an expansion does not. What is compared with is stored (tests/vectors/make_oracles.py).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from datasets import hostile_cases, noisy
from helpers import answers, model
from jax.flatten_util import ravel_pytree
from oracles import oracle

from hilbo.hyperparameters.coordinates import coordinates_of, model_at
from hilbo.hyperparameters.cost import person_ep_evidence, person_evidence
from hilbo.inference.ep_search import Cavities, find
from hilbo.kernels import gram
from hilbo.likelihoods import TiltedTerms
from hilbo.ordinal_gp import fit
from tests.vectors import evidence
from tests.vectors.evidence import EVERY, HASTY, STEP

NOTHING = {"laplace": jnp.zeros(25), "ep": (jnp.zeros(25), jnp.full(25, -jnp.inf, float))}


@eqx.filter_jit
def expanded(gp, trials, coordinates, start):
    return (person_ep_evidence if isinstance(start, tuple) else person_evidence)(gp, coordinates, trials, start)


def assert_expansion(expansion, value, gradient, hessian):
    assert bool(expansion.certified)
    np.testing.assert_allclose(expansion.value, value, rtol=1e-13)
    np.testing.assert_allclose(expansion.gradient, gradient, rtol=0, atol=1e-11 * np.abs(hessian).max())
    np.testing.assert_allclose(expansion.hessian, hessian, rtol=0, atol=1e-11 * np.abs(hessian).max())


@pytest.fixture(scope="module", params=["laplace", "ep"])
def one(request):
    gp, trials = model(evidence.three()), answers(evidence.three())
    coordinates = coordinates_of(gp, EVERY)
    nothing = NOTHING[request.param]
    return request.param, gp, trials, coordinates, expanded(gp, trials, coordinates, nothing), nothing


def test_value_gradient_and_hessian_are_those_of_the_fit(one):
    known = oracle("evidence")[one[0]]
    assert_expansion(one[4], known["value"], known["gradient"], known["hessian"])


@pytest.mark.deep
@pytest.mark.parametrize("inference", ["laplace", "ep"])
def test_some_hyperparameters_are_a_part_of_all(inference):
    """Theta per dimension, four categories; of the likelihood alone and of the kernel alone, too."""
    gp, trials = model(noisy()), answers(noisy())
    value, gradient, hessian = evidence.through_the_fit(gp, trials, inference)
    names = ravel_pytree({k: np.full(np.shape(v), i) for i, (k, v) in enumerate(coordinates_of(gp, EVERY).items())})[0]
    of = list(coordinates_of(gp, EVERY))
    for learn in (EVERY, ("noise",), ("theta",)):
        coordinates = coordinates_of(gp, learn)
        part = np.isin(names, [of.index(k) for k in coordinates])
        expansion = expanded(gp, trials, coordinates, NOTHING[inference])
        assert_expansion(expansion, value, gradient[part], hessian[np.ix_(part, part)])


def test_derivatives_are_differences_of_the_reference(one):
    inference, gp, trials, coordinates, expansion, nothing = one
    flat, restore = ravel_pytree(coordinates)
    known = oracle("evidence")[inference]["reference"]
    middle, above, below = known["middle"], known["above"], known["below"]
    np.testing.assert_allclose(expansion.gradient, (above - below) / (2 * STEP), rtol=0, atol=1e-5)
    np.testing.assert_allclose(np.diag(expansion.hessian), (above - 2 * middle + below) / STEP**2, rtol=0, atol=1e-3)
    place = expanded(gp, trials, restore(flat + STEP), nothing).place
    for moved, before, slope in zip(*map(jax.tree.leaves, (place, expansion.place, expansion.moved)), strict=True):
        np.testing.assert_allclose((moved - before) / STEP, slope.sum(axis=1), rtol=0, atol=1e-2)


@pytest.mark.parametrize("start", [0.3, -40.0, 1e200, np.nan])
def test_where_the_search_begins_changes_nothing(one, start):
    _, gp, trials, coordinates, expansion, nothing = one
    again = expanded(gp, trials, coordinates, jax.tree.map(lambda leaf: jnp.full_like(leaf, start), nothing))
    assert bool(again.certified)
    np.testing.assert_allclose(again.hessian, expansion.hessian, rtol=1e-9)


@pytest.mark.deep  # searches over many people expand each so, and their ends are judged by default tests
@pytest.mark.parametrize("inference", ["laplace", "ep"])
def test_people_are_expanded_as_if_alone(inference):
    gp, trials, nothing = model(evidence.three()), answers(evidence.three()), NOTHING[inference]
    coordinates = coordinates_of(gp, EVERY)
    stacked, starts = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf[::-1]]), (trials, nothing))
    both = jax.vmap(expanded, in_axes=(None, 0, None, 0))(gp, stacked, coordinates, starts)
    alone = expanded(gp, trials, coordinates, nothing)
    np.testing.assert_allclose(both.hessian, np.stack([alone.hessian] * 2), rtol=1e-9)


@pytest.mark.parametrize(("distance", "steps"), [(0.01, 3), (0.3, 5)])
def test_what_moves_leads_near_the_next_one(distance, steps):
    """The cavities moved along their derivatives save most of the steps, and change nothing."""
    gp, trials = model(evidence.three()), answers(evidence.three())
    coordinates = coordinates_of(gp, EVERY)
    flat, restore = ravel_pytree(coordinates)
    along = ravel_pytree({name: jnp.full_like(at, name in ("theta", "noise")) for name, at in coordinates.items()})[0]
    here = expanded(gp, trials, coordinates, NOTHING["ep"])
    ahead = restore(flat + distance * along)
    near = jax.tree.map(lambda place, moved: place + moved @ (distance * along), here.place, here.moved)
    there = expanded(gp, trials, ahead, NOTHING["ep"])
    np.testing.assert_allclose(expanded(gp, trials, ahead, near).hessian, there.hessian, rtol=1e-8)
    moved = model_at(ahead, gp)
    terms = TiltedTerms(moved.likelihood, trials.q, trials.mask)
    covariance = gram(moved.kernel, trials.x, trials.x)
    starts = (Cavities(near[0], jnp.exp(near[1])), Cavities(*NOTHING["ep"]))
    few, many = (int(jax.jit(find, static_argnums=3)(terms, covariance, start, 200)[2].iterations) for start in starts)
    assert few <= steps < many


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.deep] * ("n=200" in name)) for name in HASTY])
def test_haste_leaves_nothing_undone(name):
    """Where rounding is as large as the tolerance, the last step of a hasty search is not the last."""
    data = next(case for case in hostile_cases() if case.name == name)
    gp, trials = model(data), answers(data, len(data.q))
    nothing = jnp.zeros(len(data.q)), jnp.full(len(data.q), -jnp.inf, float)
    expansion = expanded(gp, trials, coordinates_of(gp, EVERY), nothing)
    assert bool(expansion.certified)
    # the covariance's own rounding
    np.testing.assert_allclose(expansion.value, oracle("evidence")["hasty"][name], rtol=1e-7)


@pytest.mark.deep
@pytest.mark.parametrize("inference", ["laplace", "ep"])
def test_a_certified_float32_evidence_is_right(inference):
    """Over 200 models from harmless to hopeless; a search that ended well is not enough (14 of them were wrong)."""
    trials = evidence.scattered_trials(jnp.float32)
    nothing = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), NOTHING[inference])

    def one(scattered):
        gp = evidence.scattered_gp(scattered, jnp.float32)
        expansion = expanded(gp, trials, coordinates_of(gp, ("theta", "noise")), nothing)
        fitted = fit(gp, trials, inference=inference, throw=False)
        ended = fitted.certificate.residual <= fitted.certificate.tolerance
        return (
            jnp.stack([expansion.value, fitted.log_evidence]),
            (expansion.certified, fitted.certificate.converged),
            ended,
        )

    values, certified, ended = jax.jit(lambda models: jax.lax.map(one, models))(jnp.asarray(evidence.SCATTERED))
    stored = oracle("evidence")["scattered"][inference]
    exact, known = stored["value"][:, None], stored["known"].astype(bool)
    right = np.abs(np.asarray(values) - exact) <= 0.02 + np.finfo(np.float32).eps ** 0.5 * np.abs(exact)
    for number, sure in enumerate(map(np.asarray, certified)):
        assert right[sure & known, number].all() and sure.sum() > 100
    assert (np.asarray(ended) & known & ~right[:, 1]).any()
