"""What contexts, such as clips, add to everybody's answers: against the dense model of all answers, and its limits."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import OrdinalGP, Trials, fit
from hilbo.population.judged.leave_one_out import _newcomer
from hilbo.population.maps import RuleMap
from hilbo.population.shared.features import pivots_of
from hilbo.population.shared.hierarchical import PersonKernel
from hilbo.population.shared.low_rank import shared_evidence
from hilbo.population.shared.people_model import PeopleModel
from hilbo.population.shared.posterior import shared_function
from hilbo.population.shared.tallies import Tallies, tallied

EXACT, PEOPLE, ANSWERS, CONTEXTS, RANK = 1e-15, 3, 8, 3, 24
NOBODY = -1.0  # the number of a person who gave no answers
NOWHERE = -1.0  # a context that nobody was asked in


def stacked():
    """Answers of three people, each at points of their own, in contexts by chance."""
    rng = np.random.default_rng(7)
    x, q = rng.uniform(size=(PEOPLE, ANSWERS, 2)), rng.integers(0, 3, (PEOPLE, ANSWERS))
    mask = np.arange(ANSWERS)[None, :] < np.array([8, 7, 5])[:, None]
    context = rng.integers(0, CONTEXTS, (PEOPLE, ANSWERS)).astype(np.int32)  # as `tallied` counts them
    return jax.vmap(Trials)(*map(jnp.asarray, (x, q, mask, context)))


def model(effect=0.5):
    return PeopleModel(
        theta=jnp.array([3.0, 5.0]),
        shared=jnp.asarray(0.6),
        own=jnp.asarray(0.4),
        thresholds=jnp.array([-0.4, 0.5]),
        noise=jnp.asarray(0.7),
        log_widths=jnp.zeros(PEOPLE),
        effect=None if effect is None else jnp.asarray(effect),
    )


class ContextKernel(eqx.Module):
    """Covariance at points (x, person, context): people's, and `effect` within a context."""

    people: PersonKernel
    effect: jax.Array

    def __call__(self, x, y):
        return self.people(x[:-1], y[:-1]) + jnp.where(x[-1] == y[-1], self.effect, 0.0)

    def diagonal(self, x):
        return self.people.diagonal(x[:-1]) + self.effect


@eqx.filter_jit
def dense(people, trials):
    """The posterior of all answers at once."""
    kernel = ContextKernel(PersonKernel(people.gp.kernel, people.share), people.effect)
    person = jnp.broadcast_to(jnp.arange(PEOPLE, dtype=float)[:, None], trials.mask.shape)
    points = jnp.concatenate([trials.x, person[..., None], trials.context[..., None].astype(float)], axis=-1)
    everybody = Trials(points.reshape(-1, 4), trials.q.reshape(-1), trials.mask.reshape(-1))
    return fit(OrdinalGP(kernel, people.gp.likelihood), everybody, throw=False)


@pytest.fixture(scope="module")
def by_all():
    posterior = dense(model(), stacked())
    assert bool(posterior.certificate.converged)
    return posterior


def places():
    return jnp.asarray(np.random.default_rng(1).uniform(size=(20, 2)))


def at(x, context):
    """Points of a person nobody has met."""
    columns = np.full(len(x), NOBODY), np.broadcast_to(np.asarray(context, float), len(x))
    return jnp.asarray(np.concatenate([x, np.stack(columns, axis=1)], axis=1))


def pivots(answers):
    return pivots_of(model().unit, answers, RANK, EXACT)


@jax.jit
@jax.value_and_grad
def evidence(effect, answers):
    return shared_evidence(model(effect), answers, answers.blank, pivots(answers)).value


def tallied_apart(trials):
    """Every answer as a point of its own."""
    counts = np.where(np.asarray(trials.mask)[..., None], np.eye(3)[np.asarray(trials.q)], 0.0)
    return Tallies(trials.x, jnp.asarray(counts), trials.context, CONTEXTS)


def test_the_shared_function_is_the_dense_models(by_all):
    answers = tallied(stacked(), 3)
    posterior = shared_function(model(), answers, answers.blank, pivots(answers)).function
    mean, explained = by_all.predict_explained(at(places(), NOWHERE))
    np.testing.assert_allclose(posterior.log_evidence, by_all.log_evidence, rtol=1e-10)
    np.testing.assert_allclose(posterior.predict(places()), (mean, 0.6 - explained), atol=1e-7)
    assert bool(posterior.certificate.converged)


def test_contexts_add_what_the_dense_model_says(by_all):
    answers = tallied(stacked(), 3)
    effects = shared_function(model(), answers, answers.blank, pivots(answers)).effects
    context = np.arange(20) % CONTEXTS
    shift, more = jax.jit(lambda *at: effects.added(*at))(places(), jnp.asarray(context))
    mean, explained = by_all.predict_explained(at(places(), NOWHERE))
    within, explained_within = by_all.predict_explained(at(places(), context))
    np.testing.assert_allclose(shift, np.subtract(within, mean), atol=1e-7)
    np.testing.assert_allclose(more, 0.5 + np.subtract(explained, explained_within), atol=1e-7)


def test_the_gradient_in_the_variance_is_that_of_differences():
    answers, step = tallied_apart(stacked()), 1e-3
    slope = evidence(0.5, answers)[1]
    a, b, c, d = (evidence(0.5 + k * step, answers)[0] for k in (-2, -1, 1, 2))
    np.testing.assert_allclose(slope, (a - 8 * b + 8 * c - d) / (12 * step), atol=1e-8)


def test_an_effect_without_variance_is_none():
    answers = tallied(stacked(), 3)
    none = tallied(eqx.tree_at(lambda t: t.context, stacked(), None), 3)
    without = shared_function(model(None), none, none.blank, pivots(none)).function
    limit = shared_function(model(1e-14), answers, answers.blank, pivots(answers)).function
    np.testing.assert_allclose(limit.log_evidence, without.log_evidence, rtol=1e-12)
    np.testing.assert_allclose(limit.predict(places()), without.predict(places()), atol=1e-10)


def test_answers_at_one_point_are_added_up_within_a_context_only():
    x = np.array([[0.9, 0.1], [0.9, 0.1], [0.9, 0.1], [0.2, 0.3]])
    q, context = jnp.array([[2, 1, 1, 0]]), jnp.array([[1, 0, 1, 1]])
    one = jax.vmap(Trials)(jnp.asarray(x)[None], q, jnp.ones((1, 4), bool), context)
    answers = tallied(one, 3)
    np.testing.assert_array_equal(answers.x[0], x[[0, 1, 3]])
    np.testing.assert_array_equal(answers.context[0], [1, 0, 1])
    np.testing.assert_array_equal(answers.counts[0], [[0, 1, 1], [0, 1, 0], [1, 0, 0]])
    assert answers.contexts == 2


def test_what_a_context_adds_is_learnt_from_one_answer_in_it_wherever_that_was():
    """A new person at two corners of the square, where the kernel hardly correlates; nobody was asked in context 1."""
    trials = eqx.tree_at(lambda t: t.mask, stacked(), stacked().mask & (stacked().context != 1))
    answers, people = tallied_apart(trials), model(4.0)
    function, effects = shared_function(people, answers, answers.blank, pivots(answers))
    of_all = RuleMap("learnt-2", "exact", None, function, people.share, jnp.asarray(1.0), effects=effects)

    def second(first_answer, contexts):
        said = jnp.array([first_answer, 0]), jnp.ones(2, bool), jnp.array(contexts)
        return np.asarray(_newcomer(people.gp, of_all, jnp.array([[0.0, 0.0], [1.0, 1.0]]), *said).probabilities[1])

    assert second(2, [1, 1])[2] - second(0, [1, 1])[2] > 0.5
    np.testing.assert_allclose(second(2, [1, 0]), second(0, [1, 0]), atol=1e-3)
