"""What a notebook meets: mistakes in one sentence, and records whose words are short."""

import copy
import importlib
import os
import pickle
import re
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from studies import PLAIN

import hilbo
from hilbo import (
    RBF,
    InputError,
    OrdinalGP,
    OrdinalProbit,
    Session,
    Study,
    Trials,
    bcm,
    fit,
    passivity,
    viscoelastic,
)
from hilbo.errors import InputRemark
from hilbo.kernels import Matern32
from hilbo.search.box import Mechanics, Parameter


@pytest.fixture(scope="module")
def posterior():
    rng = np.random.default_rng(0)
    gp = OrdinalGP(RBF(5.0), OrdinalProbit((-0.5, 0.5), 0.5))
    return fit(gp, Trials.from_arrays(rng.uniform(size=(7, 2)), rng.integers(0, 3, 7)))


@pytest.fixture(scope="module")
def session():
    return Session.start(Study.from_dict(PLAIN), seed=0)


def with_first(trials, name, value):
    """Trials whose first row holds something else."""
    return eqx.tree_at(lambda t: getattr(t, name), trials, getattr(trials, name).at[0].set(value))


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
    "rows of different lengths": (
        lambda p, s: p.predict([[0.1, 0.2], [0.3]]),
        "Posterior: x is [[0.1, 0.2], [0.3]]; give numbers, in rows of one length.",
    ),
    "a point that is no number": (
        lambda p, s: p.predict([[0.1, 0.2], [0.3, np.nan]]),
        "Posterior: x[1] has a value that is not finite; give points of the unit cube.",
    ),
    "a seed below 0": (
        lambda p, s: Session.start(s.study, seed=-1),
        "Session: seed is -1; it must be a whole number from 0.",
    ),
    "an order above 1": (
        lambda p, s: passivity.minimum_damping(5.0, 7.0, np.array([0.5, 1.5])),
        "alpha is 1.5; it must be above 0 and at most 1: the order of the fractional element.",
    ),
    "a damping below 0": (lambda p, s: passivity.largest_K1(7.0, 0.5, b=-1.0), "b is -1.0; it must be 0 or above."),
    "a certificate for a damping below 0": (
        lambda p, s: passivity.certify(viscoelastic.FOSLS(-3, 5, 7, 0.2), -0.95),
        "b is -0.95; the damping of a device is 0 or above, in N.s/m.",
    ),
    "one point": (lambda p, s: p.mean(np.zeros(2)), "Posterior: x has shape (2,); give points of shape (m, 2)."),
    "chances at one point": (
        lambda p, s: p.class_probabilities(jnp.full(2, 0.5)),
        "Posterior: x has shape (2,); give points of shape (m, 2).",
    ),
    "several participants": (
        lambda p, s: jax.vmap(lambda _: p)(jnp.arange(2)).predict(np.zeros((1, 2))),
        "Posterior: several participants; predict for each of them by jax.vmap.",
    ),
    "complex points": (
        lambda p, s: Trials.from_arrays(np.full((1, 2), 0.5j), np.array([0])),
        "Trials: x is of type complex128; give numbers, as float32 or float64.",
    ),
    "points that are text": (
        lambda p, s: Trials.from_arrays(np.array([["a", "b"]]), np.array([0])),
        "Trials: x is of type <U1; give numbers, as float32 or float64.",
    ),
    "points of half the digits": (
        lambda p, s: Trials.from_arrays(np.full((1, 2), 0.5, np.float16), np.array([0])),
        "Trials: x is of type float16; give numbers, as float32 or float64.",
    ),
    "points of nothing": (
        lambda p, s: Trials.empty(3, 0),
        "Trials: x has shape (0, 0); give one column at least: each is a parameter.",
    ),
    "a category beyond 32 bits": (
        lambda p, s: Trials.from_arrays(np.zeros((1, 2)), np.array([2**32 + 1])),
        "Trials: q must contain the categories as integers from 0 (lowest) to C - 1 (highest).",
    ),
    "one coordinate of two": (
        lambda p, s: p.trials.append(jnp.array([0.5]), 1),
        "Trials: x has shape (1,); append one point, of shape (2,).",
    ),
    "half a category": (
        lambda p, s: p.trials.append(jnp.array([0.5, 0.5]), 1.5),
        "Trials: q must contain the categories as integers from 0 (lowest) to C - 1 (highest).",
    ),
    "a point that is nowhere": (
        lambda p, s: p.trials.append([0.5, np.nan], 1),
        "Trials: x is [0.5, nan]; give finite numbers.",
    ),
    "one answer more than there is room for": (
        lambda p, s: Trials.from_arrays(np.zeros((1, 2)), np.array([0]), 1).append([0.5, 0.5], 1),
        "Trials: all 1 rows have a response; make it with a larger capacity.",
    ),
    "one answer to several participants": (
        lambda p, s: jax.vmap(lambda _: p.trials)(jnp.arange(2)).append([0.5, 0.5], 1),
        "Trials: 2 participants; append to the responses of one, or use jax.vmap.",
    ),
    "the answers of several participants": (
        lambda p, s: fit(p.gp, jax.vmap(lambda _: p.trials)(jnp.arange(2))),
        "fit: these trials are of 2 people; fit those of one, or use jax.vmap with throw=False.",
    ),
    "a category below 0": (
        lambda p, s: fit(p.gp, with_first(p.trials, "q", -1)),
        "fit: an answer has category -1, but the likelihood has 2 thresholds and so the categories 0 to 2; check the"
        " answers or the thresholds.",
    ),
    "an answer at no point": (
        lambda p, s: fit(p.gp, with_first(p.trials, "x", np.nan)),
        "fit: x[0] of the trials is not finite; fix that answer or take it out.",
    ),
    "a start for fewer answers": (
        lambda p, s: fit(p.gp, p.trials, start=jnp.zeros(3)),
        "fit: start has shape (3,); give one weight for each of 32 rows.",
    ),
    "levels for 1 of 2 parameters": (
        lambda p, s: fit(OrdinalGP(RBF(5.0, levels=(3,)), p.gp.likelihood), p.trials),
        "fit: the kernel has levels (3,) and x 2 parameters; give 2 of them.",
    ),
    "probabilities at several values": (
        lambda p, s: p.gp.likelihood.class_probabilities(jnp.zeros(12)),
        "OrdinalProbit: value, category, thresholds and noise have the shapes (12,), (), (2,) and (); all but the"
        " thresholds are scalars, use jax.vmap for several.",
    ),
    "creep with a K0 below 0": (
        lambda p, s: viscoelastic.creep_compliance(np.array([0.01, 0.1]), -2.89, 5.7, 5.89, 0.203),
        "K0 is -2.89; it must be 0 or above.",
    ),
    "relaxation of order 1.5": (
        lambda p, s: viscoelastic.relaxation_modulus(1.0, 1.0, 1.0, 1.0, 1.5),
        "alpha is 1.5; it must be above 0 and at most 1: the order of the fractional element.",
    ),
    "the best of nothing": (
        lambda p, s: s.best(),
        "Session: there are no responses yet, hence no best stimulus; add one with tell() first.",
    ),
    "a seed of more than 64 bits": (
        lambda p, s: Session.start(s.study, seed=2**63),
        "Session: seed is 9223372036854775808; it must be at most 9223372036854775807, which is 2^63 - 1.",
    ),
    "an array at a point": (
        lambda p, s: s.tell("close", {"u": np.array([0.5]), "v": 12}),
        "Session: u is array([0.5]); give a number.",
    ),
    "a whole row of a table": (
        lambda p, s: s.tell("close", pd.Series({"u": 0.5, "v": 12.0, 7: 1})),
        "Session: at has u, v, 7; give u, v.",
    ),
    "another parameter": (lambda p, s: s.tell("close", {"u": 0.5, "w": 0.5}), "Session: at has u, w; give u, v."),
    "out of range": (
        lambda p, s: s.tell("close", {"u": 0.5, "v": 0.5}),
        "Session: v is 0.5; it must be a number from 10 to 20.",
    ),
}
OF_ANOTHER_TYPE = {
    "people of two sizes": (
        lambda p, s: bcm.combine(jnp.zeros((3, 4)), jnp.ones((4, 3)), 1.0),
        "bcm: means has shape (3, 4) and variances (4, 3); give both as (M, m): a row for each participant, a column"
        " for each point.",
    ),
    "words for a theta": (lambda p, s: RBF("long"), "RBF: theta is 'long'; give numbers, in rows of one length."),
    "the likelihood first": (
        lambda p, s: OrdinalGP(p.gp.likelihood, p.gp.kernel),
        "OrdinalGP: kernel and likelihood are exchanged; give the kernel first, or both by name.",
    ),
    "arrays in place of trials": (
        lambda p, s: fit(p.gp, (np.zeros((1, 2)), [0])),
        "fit: takes an OrdinalGP and Trials, not OrdinalGP and tuple; write fit(gp, Trials.from_arrays(x, q)).",
    ),
    "a path in place of a study": (
        lambda p, s: Session.start("study.toml"),
        "Session: study is a str; load it first, by Study.load(path).",
    ),
    "a study that is none": (
        lambda p, s: Study.from_dict(None),
        "Study: this is a NoneType; give a study file's tables, or Study.load(path).",
    ),
    "words at a point": (lambda p, s: s.tell("close", {"u": "low", "v": 12}), "Session: u is 'low'; give a number."),
    "a list at a point": (
        lambda p, s: s.tell("close", [0.5, 12.0]),
        "Session: at is a list; give a dict with a value for each of u, v.",
    ),
    "a number in place of a path": (
        lambda p, s: Study.load(5),
        "Study: the path is a int; give the path of a study file, as text.",
    ),
    "half a capacity": (
        lambda p, s: Trials.from_arrays(np.zeros((1, 2)), [0], 2.5),
        "Trials: capacity is 2.5; give a whole number.",
    ),
    "points in rows of different lengths": (
        lambda p, s: Trials.from_arrays([[0.1, 0.2], [0.3]], [0, 1]),
        "Trials: x has rows of different lengths; give numbers, in rows of one length.",
    ),
    "a start with a capital": (
        lambda p, s: viscoelastic.FOSLS(-3, 5, 7, 0.2).simulate(np.ones(2), start="Equilibrium"),
        'start is "Equilibrium"; it must be "rest" or "equilibrium".',
    ),
    "words for a Matern's theta": (
        lambda p, s: Matern32("long"),
        "Matern32: theta is 'long'; give numbers, in rows of one length.",
    ),
    "a scale with a capital": (
        lambda p, s: Parameter("a", 1.0, 100.0, scale="Log"),
        'parameters.a.scale is "Log"; it must be linear or log.',
    ),
    "a long memory": (
        lambda p, s: Mechanics(0.44, 0.95, memory="long"),
        'renderer.memory is "long"; it must be short or full.',
    ),
    "one position": (
        lambda p, s: viscoelastic.FOSLS(-3, 5, 7, 0.2).simulate(1.0),
        "FOSLS: x has shape (); give one sample every T, of shape (n,).",
    ),
}
"""Which tests meet a type check before."""


@pytest.mark.parametrize("what", MISTAKES)
def test_mistakes_get_one_sentence(posterior, session, what):
    mistake, sentence = MISTAKES[what]
    with pytest.raises(InputError) as refused:
        mistake(posterior, session)
    assert str(refused.value) == sentence


@pytest.mark.deep
def test_mistakes_of_type_get_one_sentence_where_nobody_checks_types():
    code = (
        "import test_in_python as here\n"
        "posterior, session = here.posterior.__wrapped__(), here.session.__wrapped__()\n"
        "for what, (mistake, sentence) in here.OF_ANOTHER_TYPE.items():\n"
        "    try:\n"
        "        mistake(posterior, session)\n"
        "    except here.InputError as error:\n"
        "        assert str(error) == sentence, (what, str(error))\n"
        "    else:\n"
        "        raise AssertionError(what)\n"
        "print('all')\n"
    )
    place = Path(__file__).parent
    path = os.pathsep.join([str(place), str(place / "support"), str(place.parent)])
    run = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": path, "JAX_ENABLE_X64": "1"},
    )
    assert run.stdout == "all\n", run.stderr


IMPOSSIBLE = {
    "a damping factor below 0": (passivity.largest_K1, (-1.0, 0.5)),
    "an order below 0": (passivity.largest_K1, (1.0, -0.5)),
    "an order above 1": (passivity.minimum_damping, (1.0, 1.0, 1.5)),
    "a model of order above 1": (lambda *values: viscoelastic.FOSLS(*values).dc_gain(), (0.5, 1.0, 1.0, 1.5)),
    "a modulus before time 0": (viscoelastic.relaxation_modulus, (-1.0, 1.0, 1.0, 1.0, 0.5)),
    "creep with a K0 below 0": (viscoelastic.creep_compliance, (1.0, -2.0, 1.0, 1.0, 0.5)),
    "the settling time of a negative B1": (
        lambda B: viscoelastic.FOSLS(1.0, 1.0, B, 0.5).settling_time(0.9),
        (-2.0,),
    ),
    "full memory with a K0 below 0": (
        lambda K0: viscoelastic.FOSLS(K0, 1.0, 1.0, 0.5, memory="full").dc_gain(),
        (-1.0,),
    ),
    "a constant order of 1.5": (lambda K0: viscoelastic.FOSLS(K0, 1.0, 1.0, 1.5).dc_gain(), (0.5,)),
    "a noise below 0": (lambda noise: OrdinalProbit((-0.5, 0.5), noise).class_probabilities(0.1, 0.3), (-0.5,)),
    "a noise below 0 and one answer": (lambda noise: OrdinalProbit((-0.5, 0.5), noise).log_prob(0.1, 1), (-0.5,)),
    "falling thresholds": (lambda t: OrdinalProbit(t, 0.5).log_prob(0.1, 0), (np.array([0.5, -0.5]),)),
    "a category below 0": (lambda q: OrdinalProbit((-0.5, 0.5), 0.5).log_prob(0.1, q), (-2,)),
}


@pytest.mark.parametrize("what", IMPOSSIBLE)
def test_traced_values_that_no_model_has_give_nan(what):
    function, values = IMPOSSIBLE[what]
    assert np.isnan(jax.jit(function)(*values)).all()


def test_an_answer_goes_into_the_first_free_row():
    trials = with_first(Trials.from_arrays(np.full((4, 2), 0.5), np.array([0, 1, 2, 1]), 8), "mask", False)
    more = trials.append([0.9, 0.9], 0)
    np.testing.assert_array_equal(more.q[:5], [0, 1, 2, 1, 0])
    assert more.mask.sum() == 4 and more.x[0, 0] == 0.9


def test_rows_without_an_answer_have_no_influence(posterior):
    gp, trials = posterior.gp, posterior.trials
    rubbish = Trials(trials.x.at[7:].set(np.nan), trials.q.at[7:].set(-1), trials.mask)
    at = np.full((1, 2), 0.3)
    np.testing.assert_array_equal(fit(gp, rubbish).predict(at), posterior.predict(at))

    def evidence(noise, trials):
        return fit(OrdinalGP(gp.kernel, OrdinalProbit((-0.5, 0.5), noise)), trials, throw=False).log_evidence

    slope = jax.jit(jax.grad(evidence))
    assert slope(0.5, rubbish) == slope(0.5, trials)


def test_creep_of_a_spring_alone():
    np.testing.assert_array_equal(viscoelastic.creep_compliance(np.array([0.0, 1.0]), 2.0, 0.0, 1.0, 0.5), [0.5, 0.5])


def test_lists_are_points(posterior):
    mean, variance = posterior.predict([[0.5, 0.5]])
    assert mean.shape == variance.shape == (1,)


@pytest.mark.parametrize("dtype", [int, bool])
def test_corners_of_the_cube_may_be_whole_numbers(posterior, dtype):
    x = jnp.array([[0, 1]])
    plain, whole = x.astype(float), x.astype(dtype)
    np.testing.assert_array_equal(posterior.predict(whole), posterior.predict(plain))
    np.testing.assert_array_equal(posterior.class_probabilities(whole), posterior.class_probabilities(plain))
    assert posterior._points(plain.astype(jnp.float32)).dtype == jnp.float32
    mask, q = jnp.ones(1, bool), jnp.ones(1, int)
    np.testing.assert_array_equal(Trials(whole, q, mask).x, Trials(plain, q, mask).x)
    assert Trials(plain.astype(jnp.float32), q, mask).x.dtype == jnp.float32
    np.testing.assert_array_equal(posterior.trials.append(whole[0], 1).x, posterior.trials.append(plain[0], 1).x)


def test_a_row_of_a_table_is_a_point_and_what_was_answered_stays(session):
    row = pd.DataFrame({"u": [0.25], "v": [12.0]}).iloc[0]
    told = session.tell(session.study.responses[0], row)
    assert told.points.tolist() == [[0.25, 12.0]]
    for array in (told.points, told.answers, told.proposal, session.points):
        assert not array.flags.writeable


def test_a_number_of_32_bits_does_not_leave_its_range():
    study = Study.from_dict(PLAIN | {"parameters": {"u": {"low": 0.01, "high": 0.99}, "v": PLAIN["parameters"]["v"]}})
    step = Session.start(study, seed=0).step
    assert float(np.float32(0.99)) > 0.99 and float(np.float32(0.01)) < 0.01
    step._run = lambda *_: np.array([0.99, 10.0, 7.0], np.float32)  # the posterior's numbers stand behind the point
    count = len(step.initial)
    assert step(np.zeros((count, 2)), np.zeros(count, int)).tolist() == [0.99, 10.0]
    step._run = lambda *_: np.array([0.01, 20.0, 7.0], np.float32)
    assert step(np.zeros((count, 2)), np.zeros(count, int)).tolist() == [0.01, 20.0]


@pytest.mark.deep  # it compiles a session
def test_a_session_in_32_bits_gives_a_table_that_can_be_read():
    code = (
        "import numpy as np, pandas as pd\n"
        "from studies import PLAIN\n"
        "from hilbo import Session, Study\n"
        "from hilbo.study.cohort import cohort_of\n"
        "parameters = {'u': {'low': 0.01, 'high': 0.99}, 'v': PLAIN['parameters']['v']}\n"
        "few = {'gp': PLAIN['gp'] | {'theta': 2.0}, 'selection': {'space_filling': 3, 'trials': 8}}\n"
        "study = Study.from_dict(PLAIN | {'parameters': parameters} | few)\n"
        "session, asked = Session.start(study), []\n"
        "while not session.done:\n"
        "    asked.append(session.ask())\n"
        "    session = session.tell(study.responses[-1 if asked[-1]['u'] > 0.5 else 0])\n"
        "table = pd.DataFrame(asked).assign(participant='A', trial=np.arange(1, len(asked) + 1))\n"
        "cohort = cohort_of(table.assign(response=np.array(study.responses)[session.answers]), study)\n"
        "assert table['u'].max() == 0.99 >= session.best()['u'], table\n"
        "print(cohort.counts().tolist() == [len(asked)])\n"
    )
    path = os.pathsep.join([str(Path(__file__).parent / "support"), str(Path(__file__).parents[1])])
    env = os.environ | {"PYTHONPATH": path, "JAX_ENABLE_X64": "0"}
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert run.stdout == "True\n", run.stderr


def test_what_is_traced_is_not_checked(posterior):
    slope = jax.grad(lambda theta: RBF(theta)(jnp.zeros(1), jnp.ones(1)))(2.0)
    np.testing.assert_allclose(slope, -np.exp(-2.0), rtol=1e-6)
    assert np.isnan(jax.jit(lambda noise: OrdinalProbit((-0.5, 0.5), noise).log_prob(0.0, 1))(-1.0))


def test_records_have_short_words(posterior, session):
    for record in (posterior, posterior.gp, posterior.gp.kernel, posterior.certificate, session, session.study):
        assert len(repr(record)) < 400 and "f64[" not in repr(record) and "Array(" not in repr(record)
    assert repr(posterior).startswith("Posterior(7 answers, 2 parameters, log evidence -")
    assert repr(posterior.trials) == "Trials(7 answers, 2 parameters, room for 32)"
    assert re.fullmatch(r"GaussianPosterior\(32 values, log evidence -[\d.]+\)", repr(posterior.latent))
    two = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), posterior)
    assert repr(two) == "Posterior(2 people, 14 answers, 2 parameters, all certified)"
    assert repr(viscoelastic.FOSLS(-3, 5, 7, 0.2)) == "FOSLS(K0=-3, K1=5, B1=7, alpha=0.2, N=101, T=0.001)"
    assert repr(posterior.gp.likelihood) == "OrdinalProbit(thresholds=[-0.5, 0.5], noise=0.5)"
    assert re.fullmatch(r'Session\("plain": 0 of \d+ answers, asks u [\d.]+, v [\d.]+\)', repr(session))
    assert repr(session.study).startswith('Study("plain": u 0 to 1, v 10 to 20; ')


@pytest.mark.parametrize("duplicate", [lambda posterior: pickle.loads(pickle.dumps(posterior)), copy.deepcopy])
def test_a_posterior_that_was_saved_predicts_the_same(posterior, duplicate):
    same = duplicate(posterior)
    for one, other in zip(jax.tree.leaves(posterior), jax.tree.leaves(same), strict=True):
        np.testing.assert_array_equal(one, other)
    x = np.array([[0.2, 0.7]])
    np.testing.assert_array_equal(same.predict(x), posterior.predict(x))


@pytest.mark.parametrize("module", [bcm, passivity, viscoelastic])
def test_a_module_offers_its_own_names_alone(module):
    assert dir(module) == sorted(module.__all__)


def test_trees_of_something_else_have_words_too(posterior):
    for tree in (eqx.filter(posterior, eqx.is_inexact_array), jax.tree.map(lambda _: 0, posterior)):
        assert "Posterior" in repr(tree)
    shapes = eqx.filter_eval_shape(lambda p: p, posterior)
    assert "Posterior" in repr(shapes) and "Certificate" in repr(shapes.certificate)
    assert "converged=True" in repr(posterior.certificate)


def test_a_state_that_has_had_its_response_warns(session):
    session = copy.copy(session)  # others have given responses to the shared one
    session.ask()
    following = session.tell(session.study.responses[0])
    following.ask()
    with pytest.warns(InputRemark, match="this state has had its response; keep the next one"):
        session.ask()


def test_a_length_scale_is_another_way_to_state_theta():
    np.testing.assert_allclose(RBF(length_scale=(0.1, 0.5)).theta, [50.0, 2.0], rtol=1e-15)
    np.testing.assert_allclose(RBF(30.0).length_scale, np.sqrt(1 / 60), rtol=1e-15)
    for arguments in ({}, {"theta": 1.0, "length_scale": 1.0}):
        with pytest.raises(InputError, match="give either theta or length_scale"):
            RBF(**arguments)
    with pytest.raises(InputError, match="RBF: length_scale is -1"):
        RBF(length_scale=-1.0)


def test_trials_of_traced_arrays_are_refused_in_a_sentence():
    with pytest.raises(InputError, match="x is traced; from_arrays takes arrays outside jit and vmap"):
        jax.vmap(lambda x: Trials.from_arrays(x, np.zeros(3, int)))(jnp.zeros((2, 3, 1)))


def test_a_star_import_brings_no_modules():
    names = {}
    exec("from hilbo import *", names)
    assert {"Study", "read_trials", "aggregate", "predict", "plot_map"} <= set(names)
    assert not {"statistics", "trials", "search"} & set(names)
    assert "statistics" in dir(hilbo)


@pytest.mark.deep  # fits, and draws a map: 20 s
def test_the_guide_s_calls_can_be_made():
    page = (Path(__file__).parents[1] / "docs" / "guides" / "in-python.md").read_text(encoding="utf-8")
    study = Study.load(Path(hilbo.__file__).parent / "data" / "paper.toml")
    rng = np.random.default_rng(0)
    x = np.asarray(study.space.candidates(64, 0))[:24]
    frame = pd.DataFrame(np.asarray(study.space.to_physical(x)), columns=list(study.space.names))
    answers = {"participant": np.repeat(["A", "B", "C"], 8), "trial": np.tile(np.arange(1, 9), 3)}
    table = frame.assign(**answers, response=np.array(study.responses)[rng.integers(0, 3, 24)])
    names = {
        "table": table[[*answers, "response", *study.space.names]],
        "study": study,
        "frame": frame,
        "axes": Figure().subplots(),
        "hilbo": hilbo,
        "jax": jax,
    }
    block = page.split("```python\n")[1].split("```")[0]
    block = block.replace('study = hilbo.Study.load("study.toml")\n', "")
    block = block.replace('hilbo.read_trials("trials.csv", study)', "table").replace('("hue", "light")', '("K1", "B1")')
    exec(block, names)
    calls = re.findall(r"\| `((?:hilbo|jax)\.[^`]*)`", page)
    assert len(calls) == 5
    for call in calls:
        importlib.import_module(call.split("(")[0].rpartition(".")[0])
        assert eval(call, names) is not None
