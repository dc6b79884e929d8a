"""What pages print of a covariance is that covariance: its formula is computed as it stands."""

import math
import re

import numpy as np
import pytest
from jax import numpy as jnp

from hilbo.kernels import RBF, Matern32
from hilbo.population.learnt.posterior import KERNELS
from hilbo.population.rules.registry import RECIPES
from hilbo.report.kernel_words import covariance_words, formula

X, Y = np.array([0.1, 0.7]), np.array([0.4, 0.5])


def computed(text):
    """The number that a formula has at X and Y."""
    form, thetas = re.fullmatch(r"k\(x, x′\) = (.*), with (?:every θᵢ|θ) = (.*)", text).groups()
    theta = np.array([float(value) for value in thetas.split(", ")])
    form = (
        form.replace("−", "-").replace("Σ θᵢ (xᵢ - xᵢ′)²", "distance").replace(" · ", " * ").replace(") exp", ") * exp")
    )
    names = {"exp": math.exp, "distance": float(np.sum(theta * (X - Y) ** 2))}
    value, _, s2 = form.partition(", s² = ")
    if s2:
        names["s"] = math.sqrt(eval(s2.replace("6 ", "6 * "), names))
    return eval(value, names)


@pytest.mark.parametrize("kind", [RBF, Matern32])
@pytest.mark.parametrize("theta", [4.25, [5.75, 1.5]])
def test_the_formula_is_the_kernel(kind, theta):
    kernel = kind(theta, 2.5)
    assert computed(formula(kernel)) == pytest.approx(float(kernel(jnp.asarray(X), jnp.asarray(Y))), rel=1e-12)


def test_every_kernel_of_a_rule_has_words():
    assert covariance_words(RBF(1.0)) == "squared-exponential"
    assert {name: covariance_words(KERNELS[recipe.kernel](1.0)) for name, recipe in RECIPES.items()} == {
        "learnt-1": "squared-exponential",
        "learnt-2": "Matérn 3/2",
        "learnt-3": "Matérn 3/2",
    }


def test_levels_are_said():
    assert formula(RBF(1.0, levels=(0, 3))).endswith("two different levels of a parameter have the distance 1")
    assert "levels" not in formula(RBF(1.0, levels=(0, 0)))
