"""XLA is told how to compile only where it understands, and nothing that the environment has said already."""

import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo.numerics import compiling


def test_xla_knows_the_option():
    twice = jax.jit(lambda x: 2.0 * jnp.sin(x), compiler_options=compiling.compiler_options())
    np.testing.assert_allclose(twice(jnp.ones(3)), 2.0 * np.sin(np.ones(3)))


@pytest.mark.parametrize(
    ("version", "before", "after"),
    [
        ("0.10.2", "", "--xla_cpu_use_fusion_emitters=false"),
        ("0.8.0", "--xla_a=1", "--xla_a=1 --xla_cpu_use_fusion_emitters=false"),
        ("0.10.2", "--xla_cpu_use_fusion_emitters=true", "--xla_cpu_use_fusion_emitters=true"),
        ("0.11.0", "--xla_a=1", "--xla_a=1"),
        ("1.0.0.dev1", "--xla_a=1", "--xla_a=1"),
    ],
)
def test_flags_of_a_process(monkeypatch, version, before, after):
    monkeypatch.setattr(compiling, "version", lambda name: version)
    monkeypatch.setenv("XLA_FLAGS", before)
    compiling.set_flags()
    assert os.environ["XLA_FLAGS"] == after
    assert bool(compiling.compiler_options()) == version.startswith(("0.8.", "0.10."))
