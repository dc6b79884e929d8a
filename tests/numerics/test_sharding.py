"""Sums over people and functions of each person: in groups, with derivatives, and over several devices."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo.numerics import sharding
from hilbo.numerics.sharding import devices, host_local, of_each_person, replicated, sharded, sum_over_people

ROOT = Path(__file__).parents[2]
PEOPLE = np.random.default_rng(0).normal(size=(11, 3))


def total(scale, people):
    """A sum whose terms are no polynomials, so that a derivative needs what was computed."""
    return jnp.sum(sum_over_people(lambda person, scale: jnp.exp(scale * person), people, scale) ** 2)


def each(scale, people):
    def some(people, scale):
        return jax.lax.map(lambda person: jnp.tanh(scale * person), people)

    return jnp.sum(of_each_person(some, people, scale)[:, 0] ** 3)


def plainly(scale, people):
    return jnp.sum(jnp.sum(jnp.exp(scale * people), axis=0) ** 2), jnp.sum(jnp.tanh(scale * people)[:, 0] ** 3)


@pytest.mark.parametrize("group", [1, 3, 4, 11, 1000])
def test_a_sum_in_groups_is_the_sum_with_its_derivative(monkeypatch, group):
    monkeypatch.setattr(sharding, "_GROUP", group)
    value, slope = jax.value_and_grad(total)(0.7, PEOPLE)
    expected, slope_ = jax.value_and_grad(lambda s: plainly(s, PEOPLE)[0])(0.7)
    np.testing.assert_allclose([value, slope], [expected, slope_], rtol=1e-13)


def test_one_device_needs_no_mesh():
    assert devices() == 1
    assert sharded(PEOPLE) is PEOPLE and replicated(PEOPLE) is PEOPLE and host_local(PEOPLE) is PEOPLE


WITH_DEVICES = """
import jax, numpy as np, sys
jax.config.update("jax_enable_x64", True)
sys.path.insert(0, "tests/numerics")
from test_sharding import PEOPLE, each, plainly, total
from hilbo.numerics.sharding import devices, host_local, people_mesh
from hilbo.numerics.tracing import program
with jax.set_mesh(people_mesh()):
    assert devices() == 4
    for people in (PEOPLE, PEOPLE[:8], PEOPLE[:2]):
        for i, function in enumerate((total, each)):
            found = jax.jit(jax.value_and_grad(function))(0.7, people)
            expected = jax.value_and_grad(lambda s: plainly(s, people)[i])(0.7)
            np.testing.assert_allclose(found, expected, rtol=1e-13)
    held = program(lambda people: people + 1.0)(PEOPLE)
    assert len(held.sharding.device_set) == 4 and held.is_fully_replicated
assert len(host_local(held).sharding.device_set) == 1
"""


@pytest.mark.deep  # a process of its own, which imports JAX
def test_four_devices_give_the_same_sums_and_derivatives():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=4"
    environment = os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", WITH_DEVICES], env=environment, cwd=ROOT, check=True)
