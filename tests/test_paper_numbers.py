"""docs/results/paper.md: the column of hilbo is computed here from the sets and counts that the paper prints."""

from pathlib import Path

import numpy as np
import pytest
from reference_statistics import estimates
from studies import paper_counts

from hilbo import Study
from hilbo.mechanics.materials import PRESETS
from hilbo.passivity import minimum_damping
from hilbo.report.results import misses
from hilbo.report.validation import validate
from hilbo.search.rendering import K0_range

ROOT = Path(__file__).parents[1]
STUDY = Study.load(ROOT / "hilbo" / "data" / "paper.toml")
IDENTIFIED, POPULATION, MEAN = (np.array(preset[:4]) for preset in PRESETS.values())  # K0, K1, B1, alpha


@pytest.fixture(scope="module")
def page():
    """Rows of the tables, by their first cell: the paper's number, its place, hilbo's number."""
    text = (ROOT / "docs" / "results" / "paper.md").read_text(encoding="utf-8")
    cells = ([cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|")
    return {row[0]: row[1:] for row in cells}


@pytest.fixture(scope="module")
def validated():
    return validate(paper_counts(np.random.default_rng(1)))


def percents(x):
    """Absolute errors of a set to the identified one, in per cent of the search ranges."""
    ranges = np.array([K0_range(STUDY.space), *(p.high - p.low for p in STUDY.space.parameters)])
    return ", ".join(f"{error:.1f}" for error in 100 * np.abs(x - IDENTIFIED) / ranges) + " %"


def nrmse(x):
    """NRMSE of a set to the identified one, as the page of a report has it, with K0 in brackets."""
    unit = [np.asarray(STUDY.space.to_unit(values[1:])) for values in (x, IDENTIFIED)]
    three, four = (100 * float(error) for error in misses(STUDY, *unit))
    return f"{three:.1f} % ({four:.1f} % with K0)"


def test_errors_to_the_identified_set(page):
    text = (ROOT / "docs" / "results" / "paper.md").read_text(encoding="utf-8")
    for x, printed in ((POPULATION, "1.8, 0.4, 6.2, 2.8 %"), (MEAN, "13.1, 8.8, 13.7, 8.1 %")):
        assert percents(x) == printed and text.count(f"{printed} |") == 2  # the paper's and hilbo's
    assert page["its NRMSE"][2] == nrmse(POPULATION)
    assert page["its NRMSE (not printed)"][2] == nrmse(MEAN)


def test_mechanics(page):
    model = PRESETS["memory foam, system identification"].model()
    stiffness = float(model.dc_gain())
    assert page["effective stiffness (not printed), from the printed K0"][2] == f"{stiffness:.4f} N/mm"
    damping = float(minimum_damping(*IDENTIFIED[1:], K_eff=stiffness))
    assert page["the identified set is passive"][2] == f"from {damping:.4f} N·s/m of damping on"
    derived = PRESETS["memory foam, aggregate"]._replace(K0=0.0).model()
    assert page["K0 of K1, B1, alpha by the effective stiffness"][2] == f"−{float(derived.dc_gain()) - stiffness:.2f}"


def test_validation(page, validated):
    tables = validated.tables

    def shown(regression, term, digits):
        row = regression.table.query("term == @term and errors == 'iid'").squeeze()
        return f"{row['estimate']:.{digits[0]}f} ({row['std_error']:.{digits[1]}f})".replace("-", "−")

    assert page["table II, intercept"][2] == shown(tables.table_2, "Intercept", (4, 3))
    assert page["table II, best"][2] == shown(tables.table_2, "Best", (2, 2))
    assert page["table IV, aggregate-best"][2] == shown(tables.table_4, "Aggregate-Best", (4, 4))
    third = estimates(tables.table_3)
    expected = f"{third['Best']:.4f}, {third['Worst']:.4f}".replace("-", "−")
    assert page["table III, best and worst against mid"][2] == expected
    rates = 100 * tables.preferences.drop_duplicates(["set", "over"])["rate"].to_numpy()
    assert page["best over mid, best over worst, mid over worst"][2] == ", ".join(f"{x:.0f}" for x in rates) + " %"
    assert page["aggregate-best preferred"][2] == f"{100 * validated.overall['rate'].iloc[0]:.1f} %"


def test_hilbo_agrees_with_the_paper(page):
    """Where hilbo's column has numbers without errors in brackets, the paper's are the same, or rounded."""
    for name in ("its NRMSE", "K0 of K1, B1, alpha by the effective stiffness", "aggregate-best preferred"):
        paper, _, ours = page[name]
        digits = len(paper.split()[0].partition(".")[2])
        number = float(ours.split()[0].replace("−", "-"))
        assert f"{number:.{digits}f}".replace("-", "−") == paper.split()[0]
