"""Tables of instruments are read as the plain table is, or refused by one sentence whose remedy works."""

import random
import re
import warnings

import numpy as np
import pandas as pd
import pytest
from instrument_tables import AREA, CASES, GAP, HALF, PLAIN, SAMPLES, plain

from hilbo.errors import InputError, InputRemark
from hilbo.identification.fitting import fit
from hilbo.identification.material_tables import Material, read_material
from hilbo.identification.sampled import Sampled
from hilbo.identification.tables.layout import Layout
from hilbo.identification.tables.times import with_distinct_times

READ = [name for name, case in CASES.items() if not case.refused or case.remedy]
REFUSED = [name for name, case in CASES.items() if case.refused]
# Marks that make no other number of a number, and no unit of a unit.
MARKS = ["\t", ";", ",", '"', "\n", "\r\n", "  ", "#", "q", "[", ")", "\x00", "é", "time", "(s)", "\n\n1\t2\t3\n"]


def read(path, data: bytes, layout: Layout) -> Material:
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputRemark)
        return read_material(path, layout=layout)


def readable(name: str) -> tuple[bytes, Layout]:
    """Bytes and layout of a case, after its remedy if it has one."""
    case = CASES[name]
    return (case.data, case.layout) if case.remedy is None else case.remedy(case)


def numbers(material: Material) -> np.ndarray:
    (test,) = material.tests
    assert test.input is not None
    return np.stack([test.time, test.input[0], test.output[0]], axis=1)


def reference() -> np.ndarray:
    return np.array([[float(cell) for cell in row] for row in SAMPLES])


@pytest.mark.parametrize("name", READ)
def test_every_format_is_read_as_the_plain_table(tmp_path, name):
    values = numbers(read(tmp_path / "t.txt", *readable(name)))
    if CASES[name].exact:
        np.testing.assert_array_equal(values, reference())
    else:
        np.testing.assert_allclose(values, reference(), rtol=4e-15, atol=0)


@pytest.mark.parametrize("name", REFUSED)
def test_a_refusal_is_one_sentence_with_the_file(tmp_path, name):
    with pytest.raises(InputError, match=CASES[name].refused) as refused:
        read(tmp_path / "t.txt", CASES[name].data, CASES[name].layout)
    assert str(refused.value).startswith(str(tmp_path / "t.txt")) and "\n" not in str(refused.value)


@pytest.mark.deep
def test_every_format_gives_the_same_parameters(tmp_path):
    def parameters(data, layout):
        return np.array([*fit(read(tmp_path / "t.txt", data, layout).tests, Sampled()).parameters().values()])

    right = parameters(PLAIN, Layout())
    for name in READ:
        np.testing.assert_allclose(
            parameters(*readable(name)), right, rtol=0 if CASES[name].exact else 1e-7, err_msg=name
        )


def mutated(data: bytes, seed: int) -> bytes:
    """A file with one mark inserted, or one character removed or doubled, that is no part of a number or a unit; a line
    cut at a separator; a point for a comma or a comma for a point; or another encoding and other line ends."""
    rng = random.Random(seed)
    encoding = next(e for e in ("utf-16", "utf-8", "cp1252") if decodes(data, e))
    text = data.decode(encoding)
    place = rng.randrange(1, len(text) - 1)
    in_number = text[place] == "," and text[place - 1].isdigit() and text[place + 1].isdigit()
    what = rng.choice(["insert", "insert", "insert", "remove", "double", "line", "swap", "encode"])
    if what == "insert":
        mark = rng.choice(MARKS)
        makes_number = mark == "," and (text[place - 1].isdigit() or text[place].isdigit())
        text = text if makes_number and re.search("[;\t]", text) else text[:place] + mark + text[place:]
    elif what in ("remove", "double") and not re.match(r"[\w.%°-]", text[place]) and not in_number:
        text = text[:place] + (2 * text[place] if what == "double" else "") + text[place + 1 :]
    elif what == "line":
        lines = text.splitlines(keepends=True)
        k = rng.randrange(len(lines))
        cells = re.split("(;|\t)", lines[k])
        cut = "".join(cells[: rng.randrange(1, len(cells))]) if len(cells) > 1 else ""
        lines[k] = cut + "\n" if cut.strip() else "\n" + lines[k]
        text = "".join(lines)
    elif what == "swap" and text[place] in ".,":
        text = text[:place] + (",", ".")[text[place] == ","] + text[place + 1 :]
    elif what == "encode":
        encoding, text = (
            rng.choice(["utf-16", "utf-16-le", "utf-8-sig"]),
            text.replace("\r\n", rng.choice(["\n", "\r"])),
        )
    return text.encode(encoding, "replace")


def decodes(data: bytes, encoding: str) -> bool:
    if encoding == "utf-16":
        return data[:2] in (b"\xff\xfe", b"\xfe\xff")
    try:
        return bool(data.decode(encoding))
    except UnicodeDecodeError:
        return False


def check_mutations(tmp_path, name: str, seeds: range) -> None:
    """Every mutated file is read as before, or with a remark of its own as a part of the samples, or refused."""
    data, layout = readable(name)
    right, notes = numbers(read(tmp_path / "t.txt", data, layout)), read(tmp_path / "t.txt", data, layout).notes
    for seed in seeds:
        try:
            material = read(tmp_path / "t.txt", mutated(data, seed), layout)
        except InputError as error:
            sentence = str(error)
        else:
            sentence, values = "", numbers(material)
            if len(values) == len(right):
                np.testing.assert_allclose(values, right, rtol=4e-15, err_msg=f"{name} {seed}")
            else:
                assert material.notes != notes, f"{name} {seed}: {len(values)} rows without a word"
        assert "\n" not in sentence


@pytest.mark.parametrize("name", READ)
def test_a_damaged_file_never_gives_other_numbers_without_a_word(tmp_path, name):
    check_mutations(tmp_path, name, range(12))


@pytest.mark.deep
@pytest.mark.parametrize("name", READ)
def test_many_damaged_files_never_give_other_numbers_without_a_word(tmp_path, name):
    check_mutations(tmp_path, name, range(12, 150))


def test_equal_times_are_averaged_where_rounding_explains_them(tmp_path):
    material = read(tmp_path / "t.csv", plain(HALF), Layout())
    values = numbers(material)
    right = reference()
    np.testing.assert_allclose(values[:, 1:], (right[::2, 1:] + right[1::2, 1:]) / 2, rtol=1e-15)
    np.testing.assert_array_equal(values[:, 0], [float(row[0]) for row in HALF[::2]])
    assert material.notes == (
        "60 of 120 rows have the time of the row before, which is written to 0.01 s: rows of equal time were averaged.",
    )


def test_equal_times_that_rounding_does_not_explain_are_refused(tmp_path):
    rows = [(f"{float(10 * a):.2f}", b, c) for a, b, c in HALF]
    with pytest.raises(
        InputError, match=r"t.csv:3: time is 0.00 as in the row before, .* written to 0.01 s; delete one"
    ):
        read(tmp_path / "t.csv", plain(rows), Layout())
    falling = [*SAMPLES, *SAMPLES]
    with pytest.raises(InputError, match=r"t.csv:122: time does not increase .*\(0.00 after 1.19\); .* \"repeat\""):
        read(tmp_path / "t.csv", plain(falling), Layout())


def test_averages_of_equal_times_lie_within_the_rounding_of_the_curve():
    """A recording of 1 kHz with times to 2 ms: each average is the curve within 1 ms of the written time."""
    t = np.arange(400) * 1e-3
    cells = pd.Series([f"{0.002 * round(k / 2):.3f}" for k in range(t.size)], dtype=object)  # half to even, as printf
    curve = np.sin(3 * t)
    table = pd.DataFrame({"time": cells.astype(float), "force": curve})
    with pytest.raises(InputError, match=r"rounding does not explain, since times are written to 0\.001 s"):
        with_distinct_times(table.assign(time=10 * table["time"]), cells, 1.0, "t.csv")
    means, step = with_distinct_times(table, cells, 1.0, "t.csv")
    assert step == 0.001 and np.all(np.diff(means["time"]) > 0)
    inside = np.sin(3 * (means["time"] + 1e-3)) - np.sin(3 * (means["time"] - 1e-3))
    assert np.all(np.abs(means["force"] - np.sin(3 * means["time"])) <= inside / 2 + 1e-5)


@pytest.mark.parametrize(
    ("head", "layout", "words"),
    [
        ("time_s,position_mm,force_N", Layout(columns=("load",)), '--column is "load"; write it as QUANTITY=COLUMN'),
        ("time_s,position_mm,force_N", Layout(columns=("speed=force_N",)), "with one of time, position, force"),
        ("time_s,position_mm,force_N", Layout(columns=("force_kp=force_N",)), 'with the unit "kp"; write one of N, mN'),
        ("time_s,position_mm,force_N", Layout(columns=("force_mN=force_N",)), 'the unit "N", and --column gives it'),
        (
            "time_s,position_mm,force_N",
            Layout(columns=("force=load",)),
            'has no column "load" for --column; its columns',
        ),
        ("time_s,position_mm,force_N", Layout(columns=("force=force_N", "force=time_s")), "names the force twice"),
        ("time_s,position_mm,force_N", Layout(area=3.0), "--area and --gap are for stress and strain, and time, posit"),
        ("time_s,position_mm,force_N", Layout("creep"), 'has a column "test", and --test is given; leave --test out'),
        ("time_s,position_mm,force_N", Layout(blocks=(2,)), "has no block 2 .1: line 1, 120 rows.; choose one by"),
        ("time_s,position_mm,force_N", Layout(blocks=(1, 1)), "name each block once"),
        (
            "time_s,strain_%,stress_Pa",
            Layout(area=3.0),
            "become force and position .*: give its thickness in mm by --gap",
        ),
        ("time_s,modulus_Pa,compliance_1/Pa", Layout(), 'choose one, as by --column "modulus=modulus_Pa"'),
        ("time_s,other,modulus_Pa", Layout("creep"), "a table of moduli needs none, leave it out"),
    ],
)
def test_mistakes_in_what_is_stated(tmp_path, head, layout, words):
    with pytest.raises(InputError, match=words):
        read(tmp_path / "t.csv", plain(head=f"test,{head}"), layout)


def test_stress_and_strain_are_used_instead_of_a_modulus_where_the_geometry_is_given(tmp_path):
    rows = [(a, c, b, 1000 + i) for i, (a, b, c) in enumerate(SAMPLES)]
    rows = [(a + 1, *rest) for a, *rest in rows]
    data = plain(rows, "kind,Time (s),Stress (kPa),Strain (%),Modulus (Pa)")
    material = read(tmp_path / "t.csv", data, Layout())
    assert material.tests[0].kind == "modulus" and 'not read: "Stress (kPa)", "Strain (%)"' in material.notes[0]
    material = read(tmp_path / "t.csv", data, Layout("relaxation", area=AREA, gap=GAP))
    np.testing.assert_allclose(numbers(material)[:, 1], reference()[:, 1] * GAP / 100, rtol=1e-15)
    np.testing.assert_allclose(numbers(material)[:, 2], reference()[:, 2] * AREA / 1000, rtol=1e-15)


def test_moduli_of_a_step_are_counted_from_the_step(tmp_path):
    rows = [(100 + i, i + 1, 500 - i) for i in range(20)]
    material = read(tmp_path / "t.csv", plain(rows, "kind,Time (s),Step time (s),Modulus (Pa)"), Layout())
    assert material.tests[0].time[0] == 1 and 'not read: "Time (s)"' in material.notes[0]


def test_a_plain_table_has_no_remark(tmp_path):
    assert read(tmp_path / "t.csv", PLAIN, Layout()).notes == ()
    assert read_material("hilbo/data/memory_foam_simulated.csv").notes == ()
