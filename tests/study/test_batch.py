"""Populations merged block by block, against the same people's posteriors held all at once."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies import PEOPLE, STUDY, population_answers, population_study

from hilbo.errors import InputError
from hilbo.population.pointwise import Sums
from hilbo.search.candidates import search_points
from hilbo.study.cohort import cohort_of
from hilbo.study.estimate import distributed
from hilbo.study.estimate.aggregate import aggregate_cohort, fit_cohort
from hilbo.study.estimate.batch import _one_block, block_size, jets, refit, streamed_cohort, sums
from hilbo.study.estimate.batch_optimum import aggregate_population, optima_from, optimum_near
from hilbo.study.estimate.learnt import that_learns
from hilbo.study.estimate.optimum import population_optimum, predict_people


@functools.cache
def cohort():
    return cohort_of(population_answers(), STUDY)


@functools.cache
def candidates():
    return np.asarray(search_points(STUDY.space, 0, 256))


@functools.cache
def fitted(individuals=False):
    return refit(streamed_cohort(STUDY, cohort(), distributed.alone()), candidates(), individuals)


@functools.cache
def best():
    return optima_from(fitted().population, candidates(), fitted().sums, ("bcm", "average"))


@functools.cache
def posteriors(inference="laplace"):
    return fit_cohort(STUDY, cohort(), inference=inference)


@pytest.mark.deep
def test_the_merged_map_is_that_of_the_posteriors_held_at_once():
    for rule in ("bcm", "average"):
        merged = fitted().sums.merge(1.3, PEOPLE, rule)
        expected = predict_people(posteriors(), jnp.asarray(candidates()), rule)
        np.testing.assert_allclose(merged[0], expected[0], atol=1e-12)
        np.testing.assert_allclose(merged[1], expected[1], atol=1e-13)
    certificate = posteriors().certificate
    assert fitted().certificate["converged"].all()
    np.testing.assert_array_equal(fitted().certificate["iterations"], certificate.iterations)


def test_the_hierarchical_rule_is_sums_of_its_own():
    rule, share = "hierarchical", 0.6
    streamed = dataclasses.replace(fitted().population, rule=rule, share=share)
    merged = sums(streamed, candidates()).merge(1.3, PEOPLE, rule, share)
    expected = predict_people(posteriors(), jnp.asarray(candidates()), rule, jnp.asarray(share))
    for a, b in zip(merged, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_rules_that_are_no_sum_are_refused():
    study = dataclasses.replace(STUDY, rule="pooled")
    with pytest.raises(InputError, match='"pooled" takes all answers at once, on one device'):
        aggregate_population(study, cohort(), distributed.alone())


def test_posteriors_made_again_from_their_modes_say_the_same():
    again = sums(fitted().population, candidates())
    for one, other in zip(again, fitted().sums, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-13)


def test_jets_are_the_derivatives_of_the_sums():
    at, step = candidates()[:6], 1e-4  # as many as both searches for an optimum take
    expansions = jets(fitted().population, at)
    moved = [at + step * np.array(way) for way in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1))]
    around = sums(fitted().population, np.concatenate([at, *moved, candidates()[42:]]))
    for name in Sums._fields:
        value, gradient, hessian = (getattr(part, name) for part in expansions)
        f = getattr(around, name)[:42].reshape(7, 6)
        slope = np.stack([f[1] - f[2], f[3] - f[4]], axis=1) / (2 * step)
        bend = (f[5] + f[6] - f[1] - f[2] - f[3] - f[4] + 2 * f[0]) / (2 * step**2)
        np.testing.assert_allclose(value, f[0], rtol=1e-12)
        np.testing.assert_allclose(gradient, slope, atol=1e-5 * np.abs(slope).max())
        np.testing.assert_allclose(hessian[:, 0, 1], bend, atol=1e-4 * np.abs(hessian).max())
        np.testing.assert_allclose(hessian[:, 0, 1], hessian[:, 1, 0], rtol=1e-9)


def test_people_without_answers_add_exactly_nothing():
    whole, few, crew = cohort(), cohort().rows(np.arange(4)), distributed.alone()
    answering = np.asarray(whole.trials.mask) & (np.arange(PEOPLE) < 4)[:, None]
    padded = eqx.tree_at(lambda cohort: cohort.trials.mask, whole, jnp.asarray(answering))
    one, other = (refit(streamed_cohort(STUDY, people, crew), candidates()) for people in (few, padded))
    for of_few, of_padded in zip(one.sums, other.sums, strict=True):
        np.testing.assert_allclose(of_few, of_padded, rtol=1e-14, atol=0)
    assert not other.population.modes[4:].any()


def test_the_optimum_is_the_highest_point_of_the_map():
    many = np.asarray(search_points(STUDY.space, 5, 4096))
    for rule, optimum in best().items():
        there_and_elsewhere = jnp.asarray(np.concatenate([np.asarray(optimum.x)[None], many]))
        mean, variance = map(np.asarray, predict_people(posteriors(), there_and_elsewhere, rule))
        assert float(optimum.mean) == pytest.approx(mean[0], abs=1e-12)
        assert float(optimum.sd) == pytest.approx(np.sqrt(variance[0]), abs=1e-12)
        assert float(optimum.mean) >= mean[1:].max()
        assert np.sum(np.asarray(optimum.class_probabilities)) == pytest.approx(1, abs=1e-12)


def test_a_search_that_may_end_early_reads_the_map_off_its_last_expansion():
    """From four sides."""
    exact = best()["bcm"]
    near = np.asarray(exact.x) + 0.002 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    for optimum in optimum_near(fitted().population, near, ("bcm",) * 4, tolerance=0.003):
        np.testing.assert_allclose(optimum.x, exact.x, atol=1e-4)
        assert float(optimum.mean) == pytest.approx(float(exact.mean), abs=1e-6)


@pytest.mark.deep
def test_a_streamed_optimum_predicts_a_new_person():
    streamed = dataclasses.replace(fitted().population, rule="hierarchical", share=0.6)
    optima = optima_from(streamed, candidates(), sums(streamed, candidates()), ("hierarchical", "average"))
    for rule, share in (("hierarchical", jnp.asarray(0.6)), ("average", None)):
        small = population_optimum(STUDY, posteriors(), jnp.asarray(candidates()), rule, share)
        np.testing.assert_allclose(optima[rule].class_probabilities, small.class_probabilities, atol=1e-6)


@pytest.mark.deep
def test_everything_is_as_for_a_small_cohort():
    small = aggregate_cohort(STUDY, cohort())
    told = []
    merged = aggregate_population(
        STUDY, cohort(), distributed.alone(), say=lambda words, done, people: told.append((done, people))
    )
    np.testing.assert_allclose(merged.optimum.x, small.optimum.x, atol=1e-7)
    np.testing.assert_allclose(merged.individuals.x, small.individuals.x, atol=1e-6)
    np.testing.assert_allclose(merged.mean_of_optima, small.mean_of_optima, atol=1e-6)
    np.testing.assert_allclose(merged.alternatives["average"].x, small.alternatives["average"].x, atol=1e-7)
    np.testing.assert_allclose(merged.alternatives["ep"].x, small.alternatives["ep"].x, atol=5e-4)
    np.testing.assert_allclose(merged.alternatives["ep"].mean, small.alternatives["ep"].mean, atol=1e-6)
    assert told[0][1] == PEOPLE and (PEOPLE, PEOPLE) in told
    x = np.array([[0.2, 0.9]])
    np.testing.assert_allclose(merged.surface(x), small.surface(x), atol=1e-12)


@pytest.mark.deep
def test_a_rule_that_learns_gives_a_crowd_the_map_of_a_small_cohort():
    study = that_learns(STUDY)
    small = aggregate_cohort(study, cohort())
    large = aggregate_population(study, cohort(), distributed.alone())
    np.testing.assert_array_equal(large.study.gp.kernel.theta, small.posteriors.gp.kernel.theta[0])
    np.testing.assert_array_equal(large.optimum.x, small.optimum.x)
    np.testing.assert_allclose(large.individuals.x, small.individuals.x, atol=1e-6)
    for rule in ("bcm", "average"):
        np.testing.assert_allclose(large.alternatives[rule].x, small.alternatives[rule].x, atol=1e-6)
    x = np.array([[0.2, 0.9]])
    np.testing.assert_array_equal(large.surface(x), small.surface(x))


@pytest.mark.deep
@pytest.mark.parametrize("inference", ["ep", "exact"])
def test_other_inferences_are_fitted_again(inference):
    study = population_study(inference)
    refitted = refit(streamed_cohort(study, cohort(), distributed.alone()), candidates())
    expected = predict_people(posteriors(inference), jnp.asarray(candidates()))
    np.testing.assert_allclose(refitted.sums.merge(1.3, PEOPLE)[0], expected[0], atol=1e-9)
    again = sums(refitted.population, candidates())
    np.testing.assert_allclose(again.weighted, refitted.sums.weighted, rtol=1e-9, atol=1e-9)


@pytest.mark.deep
@pytest.mark.parametrize("task", ["individuals", "jets"])
def test_a_block_made_at_once_is_one_made_person_by_person(task):
    """As GPUs make it, and as CPUs do; the first ones keep people together in groups."""
    trials = jax.tree.map(lambda leaf: jnp.asarray(leaf[:32]), fitted().population.trials)
    modes = None if task == "individuals" else jnp.asarray(fitted().population.modes[:32])
    points = jnp.asarray(candidates()[:40])
    blocks = [
        eqx.filter_jit(_one_block)(STUDY, points, trials, modes, task, "laplace", platform)
        for platform in ("cpu", "gpu")
    ]
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-9), *[total for total, _ in blocks])
    if task == "individuals":
        np.testing.assert_allclose(blocks[1][1]["modes"], blocks[0][1]["modes"], atol=1e-10)
        np.testing.assert_allclose(blocks[1][1]["optima"][0], blocks[0][1]["optima"][0], atol=1e-7)


@pytest.mark.parametrize(("people", "platform", "size"), [(1, "cpu", 1), (24, "cpu", 2), (100_000, "cpu", 256)])
def test_blocks_are_powers_of_two_and_at_least_sixteen(people, platform, size):
    assert block_size(people, platform) == size
    assert block_size(100_000, "gpu") == 1024
