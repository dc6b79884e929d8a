"""A rendering: from a point or from values, with the K0 and the margin of the space's mechanics."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from hilbo import passivity, viscoelastic
from hilbo.search.box import Mechanics, Parameter
from hilbo.search.rendering import Rendering, derived_of
from hilbo.search.space import SearchSpace

MODEL = (Parameter("alpha", 0.01, 0.99), Parameter("K1", 1.0, 32.0, "N/mm"), Parameter("B1", 0.001, 32.0))
DEVICE = SearchSpace(MODEL, Mechanics(K_eff=0.44, damping=0.95))
VALUES = {"alpha": 0.176, "K1": 5.58, "B1": 7.88}
PLAIN = SearchSpace((Parameter.of_levels("sound", ("dull", "clear")), Parameter("n", 0.0, 4.0, integer=True)))


def test_K0_and_margin_are_those_of_the_mechanics_and_stand_where_logs_and_tables_have_them():
    rendering = Rendering.of(DEVICE, VALUES | {"K0": 99.0, "other": 1.0})
    model = (VALUES["K1"], VALUES["B1"], VALUES["alpha"], 0.44)
    K0, needed = viscoelastic.K0_from_effective_stiffness(*model), passivity.minimum_damping(*model)
    assert rendering.values == VALUES and rendering.point.tolist() == list(VALUES.values())
    assert list(rendering.parameters) == ["alpha", "K1", "B1", "K0"]
    assert list(rendering.shown) == ["K0", "alpha", "K1", "B1"]
    assert rendering.parameters["K0"] == rendering.shown["K0"] == pytest.approx(float(K0), rel=1e-12)
    assert rendering.margin == pytest.approx(0.95 - float(needed), rel=1e-12)


def test_a_point_of_the_cube_and_its_values_are_one_rendering():
    for x in DEVICE.candidates(5, 0):
        physical = DEVICE.to_physical(jnp.asarray(x))
        assert Rendering.at(DEVICE, x) == Rendering.of(DEVICE, np.asarray(physical))
        derived, margin = derived_of(DEVICE, physical)
        rendering = Rendering.at(DEVICE, x)
        assert rendering.parameters["K0"] == pytest.approx(float(derived["K0"]), rel=1e-12)
        assert rendering.margin == pytest.approx(float(margin), rel=1e-9, abs=1e-12)


def test_without_mechanics_nothing_is_derived_and_levels_are_shown_by_name():
    rendering = Rendering.at(PLAIN, np.array([1.0, 0.5]))
    assert rendering.parameters == rendering.values == {"sound": 1.0, "n": 2.0}
    assert rendering.shown == {"sound": "clear", "n": 2} and rendering.margin is None
    with pytest.raises(dataclasses.FrozenInstanceError):
        rendering.values = {}
