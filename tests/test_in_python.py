"""What a notebook meets: mistakes in one sentence, and records whose words are short."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies import PLAIN

from hilbo import RBF, InputError, OrdinalGP, OrdinalProbit, Session, Study, Trials, fit


@pytest.fixture(scope="module")
def posterior():
    rng = np.random.default_rng(0)
    gp = OrdinalGP(RBF(5.0), OrdinalProbit((-0.5, 0.5), 0.5))
    return fit(gp, Trials.from_arrays(rng.uniform(size=(7, 2)), rng.integers(0, 3, 7)))


@pytest.fixture(scope="module")
def session():
    return Session.start(Study.from_dict(PLAIN), seed=0)


MISTAKES = {
    "a theta below 0": (lambda p, s: RBF(-1.0), "RBF: theta is -1; it must be a finite number above 0."),
    "a variance that is none": (
        lambda p, s: RBF(1.0, np.nan),
        "RBF: variance is nan; it must be a finite number above 0.",
    ),
    "a noise of 0": (
        lambda p, s: OrdinalProbit((0.0,), 0.0),
        "OrdinalProbit: noise is 0; it must be a finite number above 0.",
    ),
    "falling thresholds": (
        lambda p, s: OrdinalProbit((0.5, -0.5), 1.0),
        "OrdinalProbit: thresholds is [0.5, -0.5]; it must be a list of finite numbers that rise.",
    ),
    "one threshold that is no list": (
        lambda p, s: OrdinalProbit(0.5, 1.0),
        "OrdinalProbit: thresholds is 0.5; it must be a list of finite numbers that rise.",
    ),
    "a theta for each of 3 parameters": (
        lambda p, s: fit(OrdinalGP(RBF([1.0, 2.0, 3.0]), p.gp.likelihood), p.trials),
        "fit: theta has shape (3,) and x 2 parameters; give one number or 2.",
    ),
    "points of 3 parameters": (
        lambda p, s: p.predict(np.zeros((4, 3))),
        "Posterior: x has shape (4, 3); give points of shape (m, 2).",
    ),
    "one point": (lambda p, s: p.mean(np.zeros(2)), "Posterior: x has shape (2,); give points of shape (m, 2)."),
    "chances at one point": (
        lambda p, s: p.class_probabilities(jnp.full(2, 0.5)),
        "Posterior: x has shape (2,); give points of shape (m, 2).",
    ),
    "several people": (
        lambda p, s: jax.vmap(lambda _: p)(jnp.arange(2)).predict(np.zeros((1, 2))),
        "Posterior: holds several people; predict for each of them by jax.vmap.",
    ),
    "the best of nothing": (
        lambda p, s: s.best(),
        "Session: there are no answers yet, and so no best rendering; tell one first.",
    ),
    "another parameter": (lambda p, s: s.tell("close", {"u": 0.5, "w": 0.5}), "Session: at has u, w; give u, v."),
    "out of range": (
        lambda p, s: s.tell("close", {"u": 0.5, "v": 0.5}),
        "Session: v is 0.5; it must be from 10 to 20.",
    ),
}


@pytest.mark.parametrize("what", MISTAKES)
def test_mistakes_get_one_sentence(posterior, session, what):
    mistake, sentence = MISTAKES[what]
    with pytest.raises(InputError) as refused:
        mistake(posterior, session)
    assert str(refused.value) == sentence


def test_lists_are_points(posterior):
    mean, variance = posterior.predict([[0.5, 0.5]])
    assert mean.shape == variance.shape == (1,)


def test_what_is_traced_is_not_checked(posterior):
    slope = jax.grad(lambda theta: RBF(theta)(jnp.zeros(1), jnp.ones(1)))(2.0)
    np.testing.assert_allclose(slope, -np.exp(-2.0), rtol=1e-6)
    assert np.isnan(jax.jit(lambda noise: OrdinalProbit((-0.5, 0.5), noise).log_prob(0.0, 1))(-1.0))


def test_records_have_short_words(posterior, session):
    for record in (posterior, posterior.gp, posterior.gp.kernel, posterior.certificate, session, session.study):
        assert len(repr(record)) < 400 and "f64[" not in repr(record) and "Array(" not in repr(record)
    assert repr(posterior).startswith("Posterior(7 answers, 2 parameters, log evidence -")
    assert repr(posterior.gp.likelihood) == "OrdinalProbit(thresholds=[-0.5, 0.5], noise=0.5)"
    assert repr(session).startswith('Session("plain": 0 of ') and "asks {'u': " in repr(session)
    assert repr(session.study).startswith('Study("plain": u 0 to 1, v 10 to 20; ')


def test_trees_of_something_else_have_words_too(posterior):
    for tree in (eqx.filter(posterior, eqx.is_inexact_array), jax.tree.map(lambda _: 0, posterior)):
        assert "Posterior" in repr(tree)
    shapes = eqx.filter_eval_shape(lambda p: p, posterior)
    assert "Posterior" in repr(shapes) and "Certificate" in repr(shapes.certificate)
    assert "converged=True" in repr(posterior.certificate)
