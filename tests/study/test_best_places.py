"""Where draws of a map are largest, and the place that they are most often near."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.kernels import Matern32
from hilbo.study.config import Study
from hilbo.study.estimate.best_places import best_places, nearness

STUDY = Study.load("hilbo/data/video_quality.toml")
SIDE = np.linspace(0.0, 1.0, 41)
GRID = np.stack(np.meshgrid(SIDE, SIDE), -1).reshape(-1, 2)


def centre_of(places, share):
    near = jax.vmap(lambda x: nearness(RBF(6.0), jnp.asarray(places), jnp.asarray(share), x))
    return GRID[int(np.argmax(near(jnp.asarray(GRID))))]


def test_the_centre_is_amid_draws_about_one_place():
    around = np.array([0.4, 0.6]) + 0.05 * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    assert centre_of(around, np.full(4, 0.25)) == pytest.approx([0.4, 0.6])


def test_the_centre_is_in_the_more_crowded_of_two_places_and_never_between():
    apart = np.array([[0.1, 0.1], [0.9, 0.9]])
    assert centre_of(apart, np.array([0.6, 0.4])) == pytest.approx([0.1, 0.1])
    assert centre_of(apart, np.array([0.4, 0.6])) == pytest.approx([0.9, 0.9])


def test_what_is_near_is_measured_in_lengths_of_any_kernel():
    """Of a Matern kernel too: theta = 1 / (2 l^2), and exp(-1/2) at half a length."""
    length = 0.2
    kernel = Matern32((1 / (2 * length**2), 1.0))
    place, x = jnp.array([[0.3, 0.5]]), jnp.array([0.3 + length / 2, 0.5])
    assert float(nearness(kernel, place, jnp.ones(1), x)) == pytest.approx(np.exp(-0.5))


def test_a_level_is_near_itself_alone():
    kernel = RBF((6.0, 1.0), 1.0, (0, 3))
    place = jnp.array([[0.3, 0.5]])
    same, other, far = (
        float(nearness(kernel, place, jnp.ones(1), jnp.array([0.3, level]))) for level in (0.5, 0.0, 1.0)
    )
    assert same == 1.0 and other == far == pytest.approx(np.exp(-4.0))


def test_draws_are_largest_where_people_liked_it():
    rng = np.random.default_rng(0)
    x = rng.uniform(size=(60, 2))
    felt = 2.0 - 12.0 * ((x - [0.3, 0.6]) ** 2).sum(axis=1) + 0.5 * rng.normal(size=60)
    gp = OrdinalGP(RBF(6.0, 4.0), OrdinalProbit((0.5, 1.5), 0.5))
    trials = Trials.from_arrays(x, (felt > 0.5).astype(int) + (felt > 1.5), 64)
    places = best_places(STUDY.space, STUDY.goal, [fit(gp, trials)], count=200)
    assert places.points.shape == (250, 2) and float(places.share.sum()) == pytest.approx(1.0)
    assert centre_of(places.points, places.share) == pytest.approx([0.3, 0.6], abs=0.08)
