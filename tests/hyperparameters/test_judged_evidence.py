"""Laplace's evidence is judged where its search ended: against the exact evidence, and what follows from it."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo.hyperparameters import judged_evidence
from hilbo.hyperparameters.judged_evidence import Judged, judged_sentences, maximise_judged
from hilbo.hyperparameters.maximum_evidence import MaximumEvidence
from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit, Trials, fit

PEOPLE, ANSWERS = 2, 12


def trials():
    rng = np.random.default_rng(0)
    each = []
    for _ in range(PEOPLE):
        x = rng.uniform(size=(ANSWERS, 1))
        each.append(Trials.from_arrays(x, (np.sin(7 * x[:, 0]) > 0).astype(int) + (x[:, 0] > 0.8), ANSWERS))
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def model(noise):
    return OrdinalGP(RBF(20.0, 1.0), OrdinalProbit((-0.3, 0.3), noise))


@pytest.mark.deep  # the exact evidence is sampled
@pytest.mark.parametrize("noise", [0.7, 0.03])
def test_the_error_is_that_of_the_exact_evidence(noise):
    exact = sum(
        float(fit(model(noise), jax.tree.map(lambda leaf, j=j: leaf[j], trials()), inference="exact").log_evidence)
        for j in range(PEOPLE)
    )
    laplace = sum(
        float(fit(model(noise), jax.tree.map(lambda leaf, j=j: leaf[j], trials())).log_evidence) for j in range(PEOPLE)
    )
    there = MaximumEvidence(model(noise), jnp.asarray(laplace), jnp.asarray(1), *2 * [jnp.asarray(True)], ("noise",))
    said = float(judged_evidence._error(there, trials(), True)) * PEOPLE * ANSWERS
    assert said == pytest.approx(laplace - exact, abs=0.1, rel=0.1)
    assert (said > 1.0) == (noise < 0.1)


@pytest.mark.deep  # two searches, by Laplace's evidence and by that of expectation propagation
def test_what_laplace_misjudges_is_learnt_again_and_said(monkeypatch):
    monkeypatch.setattr(judged_evidence, "TRUSTED", 10.0)
    held = maximise_judged(model(0.7), trials(), ("noise",))
    assert not bool(held.again) and judged_sentences(held) == []
    people = [jax.tree.map(lambda leaf, j=j: leaf[j], trials()) for j in range(PEOPLE)]
    laplace, ep = (
        sum(float(fit(held.maximum.gp, one, inference=name).log_evidence) for one in people)
        for name in ("laplace", "ep")
    )
    assert float(held.error) * PEOPLE * ANSWERS == pytest.approx(laplace - ep, abs=1e-6)
    monkeypatch.setattr(judged_evidence, "TRUSTED", 0.0)
    again = maximise_judged(model(0.7), trials(), ("noise",))
    by_ep = maximise_judged(model(0.7), trials(), ("noise",), inference="ep")
    assert bool(again.again) and not bool(by_ep.again)
    np.testing.assert_array_equal(again.maximum.gp.likelihood.noise, by_ep.maximum.gp.likelihood.noise)
    (sentence,) = judged_sentences(again)
    assert "they were learnt by expectation propagation instead" in sentence


def test_only_those_who_were_misjudged_are_named():
    error, again = jnp.array([0.01, -0.2, 0.09]), jnp.array([False, True, True])
    everybody = MaximumEvidence(model(0.7), error, error.astype(int), again, again, ("noise",))
    (sentence,) = judged_sentences(Judged(everybody, error, again))
    assert sentence.startswith("Laplace's evidence of 2 participants was off by 0.2 nats per response")


def test_without_any_response_nothing_is_misjudged(monkeypatch):
    none = jax.tree.map(lambda leaf: leaf[None], Trials.from_arrays(np.zeros((0, 1)), np.zeros(0, int), 3))
    at, yes = jnp.zeros(()), jnp.asarray(True)
    start = MaximumEvidence(model(0.7), at, jnp.asarray(1), yes, yes, ("noise",))
    monkeypatch.setattr(judged_evidence, "_learnt", lambda *_: start)  # no search, and nothing to compile
    monkeypatch.setattr(judged_evidence, "_error", judged_evidence._error.__wrapped__)
    monkeypatch.setattr(judged_evidence, "fit", lambda *_, **__: SimpleNamespace(log_evidence=at))
    judged = maximise_judged(model(0.7), none, ("noise",))
    assert float(judged.error) == 0.0 and not bool(judged.again) and judged_sentences(judged) == []
