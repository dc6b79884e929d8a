"""The hierarchical model by features: against the dense model, its limits, and differences of its own evidence."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.kernels import gram
from hilbo.laplace import laplace
from hilbo.population.shared.features import every_point, pivots_for, pivots_of, unexplained
from hilbo.population.shared.hierarchical import PersonKernel, fit_people, of_people, shared_posterior
from hilbo.population.shared.low_rank import shared_evidence
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.posterior import shared_function
from hilbo.population.shared.system import prior_of, system_at
from hilbo.population.shared.tallies import CountTerms, Tallies, tallied

EXACT = 1e-15  # what features may leave where nothing is to be left
PEOPLE, ANSWERS = 3, 8


def stacked(seed=0, people=PEOPLE, answers=ANSWERS):
    rng = np.random.default_rng(seed)
    each = [
        Trials.from_arrays(rng.uniform(size=(answers - j, 2)), rng.integers(0, 3, answers - j), answers)
        for j in range(people)
    ]
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each)


def model(shared=0.6, own=0.4, log_widths=(0.0,) * PEOPLE):
    return PeopleModel(*map(strong, ([3.0, 5.0], shared, own, [-0.4, 0.5], 0.7, log_widths)))


def strong(number):
    """Of a type that is not weak, so that one program takes it wherever it is from."""
    return jnp.asarray(np.array(number, float))


def apart(trials):
    """Every answer as a point of its own, so that all tests have the same shapes."""
    counts = np.where(np.asarray(trials.mask)[..., None], np.eye(3)[np.asarray(trials.q)], 0.0)
    return Tallies(trials.x, jnp.asarray(counts))


def together(trials):
    """Repeated answers added up, with as much room as those apart have."""
    answers = tallied(trials, 3)
    room = (0, 0), (0, ANSWERS - answers.x.shape[1]), (0, 0)
    return Tallies(*(jnp.asarray(np.pad(part, room)) for part in (answers.x, answers.counts)))


@eqx.filter_jit
def with_slopes(people, answers, tolerance, room=PEOPLE * ANSWERS):
    """The evidence and its slopes: one program for all tests. With more room than responses every system is solved by
    the matrix of the responses, else by that of the features."""

    def of(people):
        pivots = pivots_of(jax.lax.stop_gradient(people.unit), answers, room, tolerance)
        end = shared_evidence(people, answers, answers.blank, pivots)
        return end.value, end

    slopes, end = eqx.filter_grad(of, has_aux=True)(people)
    return end, slopes


def evidence(people, answers, tolerance=EXACT):
    return with_slopes(people, answers, strong(tolerance))[0]


def alone(gp, trials):
    """The log evidence of these answers as one person's."""
    x, q, mask = map(np.asarray, (trials.x, trials.q, trials.mask))
    return fit(gp, Trials.from_arrays(x[mask], q[mask], 32)).log_evidence


def test_is_the_dense_model():
    trials, people = stacked(), model()
    dense = fit_people(people.gp, of_people(trials), people.share)
    answers = apart(trials)
    posterior = shared_function(people, answers, answers.blank, every_point(people.unit, answers)).function
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(20, 2)))
    np.testing.assert_allclose(evidence(people, answers).value, dense.log_evidence, rtol=1e-10)
    np.testing.assert_allclose(posterior.log_evidence, dense.log_evidence, rtol=1e-10)
    for by_features, by_all in zip(posterior.predict(x), shared_posterior(dense).predict(x), strict=True):
        np.testing.assert_allclose(by_features, by_all, atol=1e-11)
    assert bool(posterior.certificate.converged)


def test_the_matrix_of_the_responses_and_that_of_the_features_give_the_same():
    people, answers = model(), apart(stacked())
    ends = [with_slopes(people, answers, strong(EXACT), room) for room in (24, 32)]
    for by_features, by_responses in zip(*map(jax.tree.leaves, ends), strict=True):
        np.testing.assert_allclose(by_responses, by_features, rtol=1e-9, atol=1e-11)


def test_a_system_is_the_same_by_either_matrix():
    people, answers = dataclasses.replace(model(), effect=strong(0.3)), apart(stacked())
    answers = dataclasses.replace(answers, context=jnp.asarray(np.arange(24).reshape(3, 8) % 4), contexts=4)
    pivots = pivots_of(people.unit, answers, 32, EXACT)
    prior = prior_of(people, answers, pivots)
    curvature = jnp.asarray(np.random.default_rng(2).uniform(0.0, 2.0, (3, 8)) * np.asarray(answers.asked))
    systems = [system_at(each, curvature) for each in (prior, prior._replace(together=None))]
    assert [each.of_responses for each in systems] == [True, False]
    right = jnp.asarray(np.random.default_rng(3).normal(size=(3, 8)))
    some = jnp.asarray(np.random.default_rng(4).normal(size=(5, 32)))
    for of in (
        lambda s: s.log_determinant,
        lambda s: s.solve(right),
        lambda s: s.covariance(),
        lambda s: s.explained(32).T @ s.explained(32),
        lambda s: s.explained_variance(some),
    ):
        np.testing.assert_allclose(*map(of, systems), rtol=1e-10, atol=1e-11)


def test_points_that_lie_close_together_lose_no_digits():
    """Points that the features cannot tell apart: what was answered there is not carried over to others."""
    trials = stacked()
    close = eqx.tree_at(lambda t: t.x, trials, jnp.asarray(0.3 + 0.1 * np.asarray(trials.x)))
    people, answers = model(), apart(close)
    dense = shared_posterior(fit_people(people.gp, of_people(close), people.share))
    pivots = every_point(people.unit, answers)
    assert int(pivots.used.sum()) < int(pivots.carry.sum()) == int(close.mask.sum())
    posterior = shared_function(people, answers, answers.blank, pivots).function
    x = jnp.asarray(np.random.default_rng(1).uniform(size=(20, 2)))
    for by_features, by_all in zip(posterior.predict(x), dense.predict(x), strict=True):
        np.testing.assert_allclose(by_features, by_all, atol=1e-11)


def test_one_person_is_an_ordinal_gp_whatever_the_features():
    trials = eqx.tree_at(lambda t: t.mask, stacked(), stacked().mask & jnp.array([[True], [False], [False]]))
    people = model()
    np.testing.assert_allclose(evidence(people, apart(trials), 1.0).value, alone(people.gp, trials), rtol=1e-12)


def test_without_own_parts_all_are_one_person():
    trials, people = stacked(), model(shared=1.0, own=0.0)
    np.testing.assert_allclose(evidence(people, apart(trials)).value, alone(people.gp, trials), rtol=1e-10)


def test_widths_are_thresholds_of_their_own():
    """Nothing shared: everybody's evidence is that of a fit with their own thresholds."""
    trials, people = stacked(), model(shared=0.0, own=0.9, log_widths=(0.4, -0.3, 0.0))
    total = 0.0
    for j, log_width in enumerate((0.4, -0.3, 0.0)):
        thresholds = 0.05 + np.exp(log_width) * np.array([-0.45, 0.45])
        gp = OrdinalGP(RBF((3.0, 5.0), 0.9), OrdinalProbit(thresholds, 0.7))
        total += float(alone(gp, jax.tree.map(lambda leaf, j=j: np.asarray(leaf)[j], trials)))
    np.testing.assert_allclose(evidence(people, apart(trials)).value, total, rtol=1e-12)


@pytest.mark.parametrize("fixed_point", [None, 1.0, 0.0])
def test_sensitivities_scale_thresholds_and_noise_about_the_fixed_point(fixed_point):
    """Nothing shared: everybody's evidence is that of a fit with their own thresholds and noise."""
    log_widths, log_sensitivities = (0.4, -0.3, 0.0), (-0.2, 0.1, 0.5)
    trials, alike = stacked(), model(shared=0.0, own=0.9, log_widths=log_widths)
    at = None if fixed_point is None else jnp.asarray(fixed_point)
    people = dataclasses.replace(alike, log_sensitivities=jnp.asarray(log_sensitivities), fixed_point=at)
    total = 0.0
    for j, (width, factor) in enumerate(zip(np.exp(log_widths), np.exp(np.negative(log_sensitivities)), strict=True)):
        own = 0.05 + width * np.array([-0.45, 0.45])
        fixed = 0.05 if fixed_point == 0.0 else own[1]
        likelihood = OrdinalProbit(fixed + factor * (own - fixed), factor * 0.7)
        person = jax.tree.map(lambda leaf, j=j: np.asarray(leaf)[j], trials)
        total += float(alone(OrdinalGP(RBF((3.0, 5.0), 0.9), likelihood), person))
    np.testing.assert_allclose(evidence(people, apart(trials)).value, total, rtol=1e-12)


def test_gradients_are_differences_of_the_dense_evidence():
    """In theta, both variances and the thresholds; the widths by differences of the evidence itself."""
    answers, people, step = apart(stacked()), model(log_widths=(0.2, -0.1, 0.3)), 1e-4
    slopes = with_slopes(people, answers, strong(EXACT))[1]
    flat, restore = jax.flatten_util.ravel_pytree(people)
    restore = jax.jit(restore)
    points = [flat + k * step * way for way in np.eye(flat.size) for k in (-2, -1, 1, 2)]
    heights = np.array([evidence(restore(z), answers).value for z in points])
    a, b, c, d = heights.reshape(-1, 4).T
    by_differences = (a - 8 * b + 8 * c - d) / (12 * step)
    np.testing.assert_allclose(jax.flatten_util.ravel_pytree(slopes)[0], by_differences, atol=1e-6)


@pytest.mark.deep  # shapes of its own, and the dense model of 114 answers
def test_what_features_leave_is_said_and_bounds_the_covariances():
    trials = stacked(people=4, answers=30)
    theta, answers = jnp.array([3.0, 5.0]), apart(trials)
    pivots = pivots_for(RBF(theta), answers)
    held = eqx.tree_at(lambda m: m.log_widths, model(), jnp.zeros(4))
    end = shared_evidence(held, answers, answers.blank, pivots)
    dense = fit_people(held.gp, of_people(trials), held.share)
    assert float(pivots.left) <= 1e-6
    np.testing.assert_allclose(unexplained(RBF(theta), answers, pivots), pivots.left, atol=1e-12)
    assert len(pivots.points) < int(trials.mask.sum())
    np.testing.assert_allclose(end.value, dense.log_evidence, atol=1e-4)


@pytest.mark.parametrize("noise", [0.7, 0.1, 0.02])
def test_the_mode_is_found_or_said_not_to_be(noise):
    """Contradictory answers at little noise; each certificate that holds is right."""
    trials = stacked()
    conflicting = eqx.tree_at(lambda t: t.x, trials, jnp.asarray(np.round(trials.x)))
    people = eqx.tree_at(lambda m: m.noise, model(), strong(noise))
    end = evidence(people, apart(conflicting))
    assert bool(end.arrived) or noise < 0.1
    if bool(end.arrived):
        dense = fit_people(people.gp, of_people(conflicting), people.share)
        np.testing.assert_allclose(end.value, dense.log_evidence, rtol=1e-8)


def test_repeated_answers_add_up_to_the_same_evidence():
    """Trials at five points, each asked in some order by everybody, against every answer as a point of its own."""
    rng = np.random.default_rng(3)
    places = rng.uniform(size=(5, 2))
    trials = stacked()
    repeated = eqx.tree_at(lambda t: t.x, trials, jnp.asarray(places[rng.integers(0, 5, (PEOPLE, ANSWERS))]))
    people = model(log_widths=(0.2, -0.1, 0.3))
    answers = tallied(repeated, 3)
    assert answers.x.shape[1] <= 5
    assert float(answers.counts.sum()) == float(repeated.mask.sum())
    added_up, one_by_one = evidence(people, together(repeated)), evidence(people, apart(repeated))
    np.testing.assert_allclose(added_up.value, one_by_one.value, rtol=1e-12)


def test_points_of_a_tally_stand_in_the_order_in_which_they_were_asked():
    x = np.array([[0.9, 0.1], [0.2, 0.3], [0.9, 0.1], [0.5, 0.5]])
    one = Trials.from_arrays(x, np.array([2, 0, 1, 1]), 6)
    answers = tallied(jax.tree.map(lambda leaf: np.asarray(leaf)[None], one), 3)
    np.testing.assert_array_equal(answers.x[0], x[[0, 1, 3]])
    np.testing.assert_array_equal(answers.counts[0], [[0, 1, 1], [1, 0, 0], [0, 1, 0]])


def test_hundreds_of_contradictory_answers_are_no_obstacle():
    """Slopes of answers that contradict each other cancel, their rounding errors do not; against the exact counts."""
    rng = np.random.default_rng(4)
    x = np.repeat(rng.uniform(size=(5, 2)), 300, axis=0)
    each = [Trials.from_arrays(x, rng.integers(0, 3, len(x))) for _ in range(PEOPLE)]
    trials, people = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *each), model()
    answers = together(trials)
    end = evidence(people, answers)
    number = jnp.broadcast_to(jnp.arange(PEOPLE, dtype=float)[:, None, None], (*answers.blank.shape, 1))
    points = jnp.concatenate([answers.x, number], axis=2).reshape(-1, 3)
    covariance = gram(PersonKernel(people.gp.kernel, people.share), points, points)
    exact = laplace(covariance, CountTerms(people.gp.likelihood, answers.counts.reshape(-1, 3)))
    assert bool(end.arrived)
    np.testing.assert_allclose(end.value, exact.log_evidence, rtol=1e-10)


# Of the dense evidence of `stacked()` at share 0.3, along theta (2), variance, thresholds (2), noise and the share.
SLOPES = (0.23571106467, -0.15735659488, -0.6432411632, 0.50073662721, -1.25667631537, 5.61685992177, 0.89133164075)


def slopes(log_evidence):
    gp = OrdinalGP(RBF(jnp.array([4.0, 2.0]), 1.5), OrdinalProbit((-0.5, 0.5), 0.5))
    slope = jax.jit(jax.grad(log_evidence, argnums=(0, 1)))(gp, jnp.asarray(0.3))
    return jax.flatten_util.ravel_pytree(slope)[0]


def test_the_evidence_has_the_derivatives_of_the_dense_one():
    answers = apart(stacked())
    pivots = every_point(RBF(jnp.array([4.0, 2.0])), answers)

    def log_evidence(gp, share):
        return shared_evidence(PeopleModel.of(gp, share, PEOPLE), answers, answers.blank, pivots).value

    np.testing.assert_allclose(slopes(log_evidence), SLOPES, rtol=1e-8)


@pytest.mark.deep  # what the default test compares with
def test_the_derivatives_of_the_dense_evidence_are_those_that_stand_here():
    everybody = of_people(stacked())
    dense = slopes(lambda gp, share: fit_people(gp, everybody, share, throw=False).log_evidence)
    np.testing.assert_allclose(dense, SLOPES, rtol=1e-9)
