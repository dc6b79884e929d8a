"""What `characterise` says of tests that were badly recorded, and of good ones."""

from types import SimpleNamespace

import numpy as np
import pytest
from material import FOAM, foam_tests, force, loads, position
from partly import partly

from hilbo.identification import characterise
from hilbo.identification.fitting import Curve, Fit, Test
from hilbo.identification.instrument import is_fitted_in_force
from hilbo.identification.material_tables import read_material
from hilbo.identification.recorded import lost_contact, position_driven
from hilbo.identification.sampled import Sampled
from hilbo.identification.sentences import recording

T = 1e-3


def said(test, T=T):
    return " ".join(recording(test, T))


def shifted(test, x=0.0, F=0.0):
    """A test with an offset of position and force."""
    put, out = (x, F) if test.kind == "relaxation" else (F, x)
    return Test(test.kind, test.time, test.output + out, test.input + put, test.start)


def without(test, rows):
    """A test without some rows."""
    kept = np.delete(np.arange(test.time.size), rows)
    return Test(test.kind, test.time[kept], test.output[:, kept], test.input[:, kept])


@pytest.mark.parametrize("repeats", [1, 4])
def test_good_records_have_nothing_said_of_them(repeats):
    for noise, rho in ((0.0, 0.0), (0.04, 0.0), (0.01, 0.9)):
        for test in foam_tests(repeats, noise=noise, rho=rho, hold=0.5):
            assert said(test) == ""
            assert said(without(test, slice(300, 450))) == ""  # a hole in which nothing happens
    for test in read_material("hilbo/data/memory_foam_simulated.csv").tests:
        assert said(test) == ""


def test_rows_far_apart_late_are_no_hole():
    (t, x), _ = loads(hold=3.0)
    rows = np.unique(np.r_[0:25, np.geomspace(25, t.size - 1, 40).astype(int)])
    assert said(Test("relaxation", t[rows], force(FOAM, x)[None, rows], x[None, rows])) == ""


@pytest.mark.parametrize("kind", [0, 1])
def test_a_step_that_fell_into_a_hole_is_said_with_its_place(kind):
    test = foam_tests(2, noise=0.01, hold=0.5)[kind]
    words = said(without(test, slice(1, 100)))
    assert f"The {test.kind} test has no rows from 0 s to 0.1 s, where its input changes by 100% of its range" in words
    assert said(without(test, slice(1, 4))) == ""  # four ticks
    assert said(without(test, slice(1, 100)), T=0.02) == ""  # five ticks of a slower rendering


def test_the_last_step_may_fall_into_a_hole_too():
    creep = foam_tests(hold=0.5)[1]
    assert "no rows from 0.45 s to 0.55 s, where its input changes by 83% of" in said(without(creep, slice(451, 550)))


@pytest.mark.parametrize("kind", [0, 1])
def test_a_beginning_off_zero_is_said_with_its_size(kind):
    test = foam_tests(2, noise=0.002, hold=0.5)[kind]
    for offset in (0.5, 12.3, -12.3):
        words = said(shifted(test, x=offset))
        assert f"The {test.kind} test does not begin at rest: its first row has a position of" in words
        assert "and no force" in words and "tare it (subtract that from every position)" in words
    assert "a force of 0.3" in said(shifted(test, F=0.3))
    assert "subtract that from every force" in said(shifted(test, F=0.3))


def test_repeats_that_begin_off_zero_by_chance_are_no_offset():
    relaxation = foam_tests(4, hold=0.5)[0]
    drift = 0.1 * np.ptp(relaxation.output) * np.array([[1.0], [1.0], [1.0], [-1.0]])
    assert said(Test("relaxation", relaxation.time, relaxation.output + drift, relaxation.input)) == ""


@pytest.mark.parametrize(("apart", "ratio"), [(0.0, None), (1e-15, None), (1e-3, 1e-9)])
def test_copies_tell_nothing_about_noise(monkeypatch, apart, ratio):
    left = SimpleNamespace(lag_one=0.0, order=0, effective=50.0, rms=1e-12, drift=1.0)
    monkeypatch.setattr(characterise, "noise", lambda fitted: (left,))
    time = np.arange(50.0)
    curve = 3 + np.exp(-time / 5)
    test = Test("modulus", time, curve + apart * np.array([[1.0], [-1.0]]))
    (row,) = characterise._noise(partly(Fit, curves=[partly(Curve, other_way=None)]), [test])
    assert row.get("over_repeat_noise") == (None if ratio is None else pytest.approx(ratio, rel=0.01))


@pytest.mark.deep
def test_a_creep_test_that_is_fitted_in_its_force_ends_where_contact_was_lost():
    """There the position is not that of the surface; other gaps, and contact, end nothing."""
    _, creep = foam_tests(2, hold=0.5)
    off = slice(560, 700)
    force = creep.input + 0.01 * np.random.default_rng(0).standard_normal(creep.input.shape)
    force[:, off] = 0.0
    lost = without(Test("creep", creep.time, creep.output, force), slice(562, 698))
    assert lost_contact(lost) == 560 and is_fitted_in_force(lost)
    driven = position_driven(lost)
    np.testing.assert_array_equal(driven.output, force[:, :560])
    np.testing.assert_array_equal(driven.time, creep.time[:560])
    assert "The handle left the material at 0.56 s of the creep test" in said(lost)
    short = without(Test("creep", creep.time, creep.output, force), slice(600, 602))
    assert lost_contact(short) == 560
    early = (np.pad(values, ((0, 0), (1, 0))) for values in (lost.output, lost.input))
    late = Test("creep", np.append(0.0, lost.time + 0.5), *early)
    assert lost_contact(late) == 561  # a pause before the first contact
    touching = without(Test("creep", creep.time, creep.output, creep.input + 0.1), slice(562, 698))
    assert lost_contact(touching) is None and lost_contact(creep) is None
    assert position_driven(touching).time.size == touching.time.size


def test_characterise_says_it():
    relaxation = shifted(without(foam_tests(2, noise=0.004, hold=0.5)[0], slice(1, 100)), F=0.3)
    words = " ".join(characterise.characterise([relaxation], Sampled()).warnings)
    assert "no rows from 0 s to 0.1 s" in words and "does not begin at rest" in words


def test_a_preload_and_a_step_in_the_first_row_are_no_offset():
    (t, x), (u, _) = loads(hold=0.5)
    assert said(Test("relaxation", t, force(FOAM, x)[None] + 0.66, x[None] + 1.5, "equilibrium")) == ""
    held, load = np.full((1, t.size), 5.0), np.full((1, u.size), 3.0)
    assert said(Test("relaxation", t, force(FOAM, held), held)) == ""
    assert said(Test("creep", u, position(FOAM, load), load)) == ""
    late = position(FOAM, load)
    late[0, 0] = 0.0
    assert said(Test("creep", u, late, load)) == ""
