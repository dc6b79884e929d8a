"""The region of the best rendering: which points it has, what it says, and how much it holds."""

import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.population.maps import RuleMap
from hilbo.study.analysis.hills import Hill
from hilbo.study.analysis.region import Region, optimum_region, region_content, region_sentences
from hilbo.study.config import Study

STUDY = Study.load("hilbo/data/video_quality.toml")
THETA = np.array([6.0, 6.0])
NOBODY = Trials.from_arrays(np.zeros((0, 2)), np.zeros(0, int), 4)


def region_of(count, seed=0, points=80):
    """The region after `count` answers about a function that is known: its best place is (0.3, 0.6)."""
    gp = OrdinalGP(RBF(6.0, 4.0), OrdinalProbit((-0.5, 0.5), 0.5))
    rng = np.random.default_rng(seed)
    x = rng.uniform(size=(count, 2))
    felt = 2.0 - 12.0 * ((x - [0.3, 0.6]) ** 2).sum(axis=1) + 0.5 * rng.normal(size=count)
    posterior = fit(gp, Trials.from_arrays(x, (felt > -0.5).astype(int) + (felt > 0.5), 64))
    one = jnp.ones(())
    return optimum_region(STUDY, RuleMap("pooled", "exact", None, posterior, one, 4.0 * one), (), seed, points)


def test_more_answers_leave_less_and_hold_the_best():
    few, many = region_of(4), region_of(60)
    assert few is not None and many is not None
    assert 0 < many.volume < 0.5 * few.volume
    assert 90 < len(many.points) + len(many.others) <= 100  # corners are in several walls
    assert many.holds(np.array([0.3, 0.6]), RBF(THETA))
    assert not many.holds(np.array([0.95, 0.05]), RBF(THETA))


def test_an_unlocated_optimum_says_so():
    some = np.zeros((2, 2))
    assert region_sentences(Region(some, some, 0.25)) == []
    (sentence,) = region_sentences(Region(some, some, 0.31))
    assert sentence.startswith("Inconclusive: the 95% credible region of the optimum covers 31%")
    assert region_sentences(None) == []
    place = np.zeros(2)
    twins = Region(some, some, 0.1, (Hill(place, place, 0.6), Hill(place, place, 0.3)))
    (sentence,) = region_sentences(twins)
    assert "on the most probable with 60%, on the next with 30%" in sentence


def test_of_levels_and_whole_numbers_each_rendering_counts_once():
    """Stone and 4 of 3 x 7 renderings are the best: one hill, and a volume in twenty-firsts."""
    study = Study.from_dict(
        {
            "schema": 1,
            "study": {"name": "discrete", "responses": ["bad", "good"]},
            "parameters": {
                "texture": {"levels": ["silk", "stone", "wood"]},
                "n": {"low": 1, "high": 7, "integer": True},
            },
            "gp": {"theta": 2.0, "variance": 4.0, "thresholds": [0.0], "noise": 0.5},
            "selection": {"trials": 6},
        }
    )
    texture, n = np.divmod(np.arange(63) % 21, 7)
    x = np.asarray(study.space.to_unit(np.stack([texture, 1 + n], axis=1).astype(float)))
    posterior = fit(study.gp, Trials.from_arrays(x, ((texture == 1) & (abs(n - 3) < 2)).astype(int), 64))
    one = jnp.ones(())
    for seed in (0, 1):
        map_ = RuleMap("pooled", "exact", None, posterior, one, 4.0 * one)
        region = optimum_region(study, map_, (), seed, 80)
        assert region is not None
        places = np.concatenate([region.points, region.others])
        assert len(np.unique(places, axis=0)) == len(places) == 21
        assert region.volume == pytest.approx(len(region.points) / 21)
        assert len({tuple(hill.top) for hill in region.hills}) == len(region.hills)
        assert not any("hill" in sentence for sentence in region_sentences(region))


def test_maps_by_points_have_none():
    one = jnp.ones(())
    assert optimum_region(STUDY, RuleMap("bcm", "by points", None, None, one, one)) is None
    assert region_content(STUDY, None) is None


def test_what_results_say_is_in_physical_units():
    hill = Hill(np.array([0.0, 1.0]), np.array([1.0, 0.0]), 1.0)
    region = Region(np.array([[0.0, 0.5], [1.0, 1.0]]), np.zeros((0, 2)), 1.0, (hill,))
    content = region_content(STUDY, region)
    assert content is not None
    (said,) = content["hills"]
    assert list(said["top"].values()) == pytest.approx([STUDY.space.parameters[0].low, STUDY.space.parameters[1].high])
    assert list(said["centre"].values()) == pytest.approx(
        [STUDY.space.parameters[0].high, STUDY.space.parameters[1].low]
    )
    parameters = STUDY.space.parameters
    assert content["parameters"][parameters[0].name] == pytest.approx([parameters[0].low, parameters[0].high])
    assert content["located"] is False


@pytest.mark.deep
@pytest.mark.release  # 25 fits; benchmarks/regions.py counts 400 studies
def test_the_best_is_in_it_as_often_as_it_says():
    """Functions drawn from the model; 95 % of 25, less three standard errors."""
    gp = OrdinalGP(RBF(6.0, 4.0), OrdinalProbit((-0.5, 0.5), 0.5))
    side = np.linspace(0.0, 1.0, 25)
    grid = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    held = 0
    for seed in range(25):
        rng = np.random.default_rng(seed)
        x = np.concatenate([rng.uniform(size=(40, 2)), grid])
        prior = 4.0 * np.exp(-6.0 * ((x[:, None] - x[None]) ** 2).sum(-1))
        eigenvalues, vectors = np.linalg.eigh(prior)
        f = vectors @ (np.sqrt(np.clip(eigenvalues, 0, None)) * rng.normal(size=len(x)))
        z = f[:40] + 0.5 * rng.normal(size=40)
        posterior = fit(gp, Trials.from_arrays(x[:40], (z > -0.5).astype(int) + (z > 0.5), 64))
        one = jnp.ones(())
        region = optimum_region(STUDY, RuleMap("pooled", "exact", None, posterior, one, 4.0 * one), (), seed, count=200)
        assert region is not None
        held += region.holds(grid[np.argmax(f[40:])], RBF(THETA))
    assert held >= 0.95 * 25 - 3 * np.sqrt(25 * 0.95 * 0.05)
