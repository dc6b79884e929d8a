"""Reading material tables: units, repeats, and one sentence for each mistake."""

import numpy as np
import pytest

from hilbo.errors import InputError
from hilbo.identification.material_tables import read_material

ROWS = [("relaxation", r, 10 * i, 0.001 * min(i, 5), 1.0 + 1 / (i + r)) for r in (1, 2) for i in range(12)]
HEAD = "test,repeat,time (ms),x [m],force_N"


def table(tmp_path, head=HEAD, rows=ROWS):
    path = tmp_path / "t.csv"
    path.write_text("\n".join([head, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def test_units_become_seconds_millimetres_and_newtons(tmp_path):
    (test,), unit, notes = read_material(table(tmp_path))
    assert (test.kind, test.repeats, test.time.size, unit, notes) == ("relaxation", 2, 12, "N/mm", ())
    np.testing.assert_allclose(test.time, np.arange(12) * 0.01)
    np.testing.assert_allclose(test.input[0], np.minimum(np.arange(12), 5))
    np.testing.assert_allclose(test.output[1], 1 + 1 / (np.arange(12) + 2))


@pytest.mark.parametrize(
    ("head", "unit", "factor"),
    [("t_s,G_kPa", "Pa", 1e3), ("time [min],modulus (MPa)", "Pa", 1e6), ("t (s),G [N/mm]", "N/mm", 1.0)],
)
def test_moduli_keep_their_own_system(tmp_path, head, unit, factor):
    rows = [(1 + i, 20 - i) for i in range(10)]
    (test,), system, _ = read_material(table(tmp_path, head, rows))
    assert (test.kind, system) == ("modulus", unit)
    np.testing.assert_allclose(test.output[0], factor * (20 - np.arange(10)))
    assert test.time[0] == (60 if "min" in head else 1)


@pytest.mark.parametrize("head", ["T (degC)", "T_s", "F_max", "t_test", "g", "x", "f (Hz)", "J", "G (m/s2)", "X_mm"])
def test_letters_that_stand_for_something_else_are_ignored(tmp_path, head):
    columns = f"test,repeat,time (ms),position [m],force_N,{head}"
    (test,), _, _ = read_material(table(tmp_path, columns, [(*row, 23) for row in ROWS]))
    np.testing.assert_array_equal(test.input[0], np.minimum(np.arange(12), 5))


@pytest.mark.parametrize(
    ("head", "words"),
    [
        ("test,repeat,t,position [m],force_N,T (degC)", 'column "t" has no unit'),
        ("test,repeat,time (ms),x [m],F_max,other", 'column "F_max" has the unit "max"'),
        ("test,repeat,time (ms),x [m],force_max,F_N", 'column "force_max" has the unit "max"'),
        ("test,repeat,time (ms),x [m],force_N,t_s", 'columns "time .ms." and "t_s" both are a time'),
    ],
)
def test_a_letter_is_no_excuse_for_a_missing_unit(tmp_path, head, words):
    with pytest.raises(InputError, match=words):
        read_material(table(tmp_path, head, [(*row, 23) for row in ROWS]))


def test_letters_in_either_case_hold_the_quantities_where_nothing_else_does(tmp_path):
    (test,), _, _ = read_material(table(tmp_path, "test,repeat,T_ms,X_m,f_N,g", [(*row, 9.8) for row in ROWS]))
    assert (test.kind, test.time[-1]) == ("relaxation", 0.11)


def test_what_was_not_fitted_has_no_say_in_the_unit(tmp_path):
    columns = "test,repeat,time_s,position_mm,force_N,modulus_Pa"
    rows = [("relaxation", 1, i / 100, min(i, 5), 1 + 1 / (i + 2), 5.0) for i in range(12)]
    (test,), unit, _ = read_material(table(tmp_path, columns, rows))
    assert (test.kind, unit) == ("relaxation", "N/mm")


def test_repeats_with_other_times_are_interpolated(tmp_path):
    rows = [(*row[:2], row[2] + (3 if row[1] == 2 and row[2] else 0), *row[3:]) for row in ROWS]
    (test,), _, notes = read_material(table(tmp_path, rows=rows))
    assert "different times" in notes[0] and "where the shortest ends" in notes[0]
    assert test.time.size == 12
    assert test.output[1, 1] == pytest.approx(np.interp(10, [0, 13], [1.5, 1 + 1 / 3]))


@pytest.mark.parametrize(("head", "slope"), [("repeat,t_s,G_Pa", -0.3), ("repeat,t_s,J_1/Pa", 0.3)])
def test_moduli_are_interpolated_in_their_logarithms(tmp_path, head, slope):
    times = np.geomspace(1e-3, 1e3, 13)
    rows = [(repeat, t, 100 * t**slope) for repeat, later in ((1, 1.0), (2, 1.3)) for t in (later * times).tolist()]
    (test,), _, notes = read_material(table(tmp_path, head, rows))
    assert "interpolated in their logarithms" in notes[0]
    np.testing.assert_allclose(test.output, np.broadcast_to(100 * test.time**slope, test.output.shape), rtol=1e-12)


def test_a_part_of_a_table(tmp_path):
    (test,), _, _ = read_material(table(tmp_path), longest=0.08)
    assert test.time[-1] == 0.08
    with pytest.raises(InputError, match='contains no test "creep"'):
        read_material(table(tmp_path), only="creep")
    with pytest.raises(InputError, match="the relaxation test has no row up to -1 s; give a --longest above 0 s"):
        read_material(table(tmp_path), longest=-1.0)


def changed(**cells):
    rows = [list(row) for row in ROWS]
    for column, value in cells.items():
        rows[3][["test", "repeat", "time", "x", "force"].index(column)] = value
    return rows


@pytest.mark.parametrize(
    ("head", "rows", "words"),
    [
        (HEAD.replace(" (ms)", ""), ROWS, 't.csv:1: column "time" has no unit; write it like "time \\(s\\)"'),
        (HEAD.replace("ms", "parsec"), ROWS, 'has the unit "parsec"'),
        (HEAD.replace("force_N", "other"), ROWS, 'found time, position among .* --column "force_N='),
        (HEAD.replace("test", "kind"), ROWS, 'column "test" is missing'),
        (HEAD + ",F_N", [(*row, 1) for row in ROWS], 'columns "force_N" and "F_N" both are a force'),
        (HEAD, changed(test="tension"), 't.csv:5: test is "tension"'),
        (HEAD, changed(force="nan"), 't.csv:5: force_N is "nan"'),
        (HEAD, changed(time=10), "t.csv:5: time does not increase"),
        (HEAD, ROWS[:5], "t.csv: The relaxation test has 5 points"),
        (HEAD, [], "has no rows"),
        ("repeat,t_s,G_Pa", [(i // 9, 1 + i, 20 - i) for i in range(18)], "t.csv: the repeats .* no time in common"),
        ("t_s,G_Pa", [(i, 5) for i in range(9)], "t.csv:2: time is not above 0"),
        ("t_s,G_Pa", [(i + 1, 5) for i in range(9)], "does not change"),
        ("t_s,G_Pa,J_1/Pa", [(1, 2, 3)], "put them into two tables"),
        ("material," + HEAD, [(i % 2, *row) for i, row in enumerate(ROWS)], "choose one with --material"),
    ],
)
def test_mistakes_have_a_place(tmp_path, head, rows, words):
    with pytest.raises(InputError, match=words):
        read_material(table(tmp_path, head, rows))


def test_opposite_signs_are_said_of_test_and_file(tmp_path):
    rows = [("relaxation", r, 10 * i, r * min(i, 1), min(i, 1 + 1 / (i + 2))) for r in (1, -1) for i in range(12)]
    with pytest.raises(InputError, match=r"t.csv: The relaxation test has position and force of opposite signs in r"):
        read_material(table(tmp_path, rows=rows))


def test_the_shipped_tables_are_read():
    fish = read_material("hilbo/data/fish_muscle.csv")
    assert (fish.tests[0].time.size, fish.stiffness_unit) == (566, "Pa")
    foam = read_material("hilbo/data/memory_foam_simulated.csv")
    assert [(test.kind, test.repeats, test.time.size) for test in foam.tests] == [
        ("relaxation", 16, 301),
        ("creep", 16, 601),
    ]
