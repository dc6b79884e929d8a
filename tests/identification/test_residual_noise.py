"""Spectra of residuals: drift, noise of the input, and neither."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from material import FOAM, foam_tests, position
from scipy.signal import lfilter

from hilbo.identification.residual_noise import DRIFTS, autoregression, weighted_normal
from hilbo.identification.sampled import Sampled

M = 1500


@pytest.fixture(scope="module")
def described():
    return jax.jit(autoregression)


def white(number):
    return np.random.default_rng((5, number)).standard_normal(M)


def walk(number, size=1.5):
    """A random walk from 0 that ends with this standard deviation."""
    return size * np.cumsum(np.random.default_rng((6, number)).standard_normal(M)) / np.sqrt(M)


def test_white_and_correlated_noise_are_no_drift(described):
    rough = [float(described(jnp.asarray(white(n))).drift) for n in range(60)]
    short = [float(described(jnp.asarray(lfilter([1], [1, -0.7], white(n)))).drift) for n in range(60)]
    assert sum(p < DRIFTS for p in rough + short) <= 3


def test_a_random_walk_is_drift_and_widens_the_interval_of_a_mean(described):
    errors, ratios = [], []
    for number in range(60):
        r = white(number) + walk(number)
        model = described(jnp.asarray(r - r.mean()))
        variance = weighted_normal(jnp.ones((M, 1)), model)[0, 0] * r.var() / M**2
        errors.append(float(model.drift))
        ratios.append(r.mean() / np.sqrt(variance))
    assert np.mean(np.array(errors) < DRIFTS) > 0.8
    assert np.mean(np.abs(ratios) < 1.96) > 0.75  # by the autoregression alone: 0.4


def test_an_autoregression_does_not_hide_a_walk(described):
    for number in range(20):
        model = described(jnp.asarray(white(number) + walk(number, 10)))
        assert int(model.order) > 0 and float(model.drift) < DRIFTS


def test_noise_of_the_input_is_recognised_in_the_output():
    """What a force sensor adds to the input of a creep test reaches the prediction through 1/H."""
    creep = foam_tests(hold=0.3)[1]
    model = Sampled()
    q, curve = jnp.asarray(model.coordinates(*FOAM)), model.prepare(creep)
    noise = np.random.default_rng(1).standard_normal(creep.time.size)
    source, gain, first = model.as_input_noise(q, curve, jnp.asarray(position(FOAM, noise)))
    np.testing.assert_allclose(source, noise, atol=1e-9)
    assert float(first) == pytest.approx(float(q[0]))
    assert float(gain[0]) == pytest.approx(1 / 0.44325**2, rel=1e-4)  # at rest: 1/H(1)
