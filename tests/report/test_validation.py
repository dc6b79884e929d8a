"""`hilbo validate`: the paper's tables and the page, what few comparisons can say, and simulated judges."""

import json
import re

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from commands import run
from studies import PLAIN, paper_counts, plain

from hilbo import Study
from hilbo.report.page import rendered
from hilbo.report.study.dictionary import dictionary
from hilbo.report.validation import (
    folder_names,
    p_words,
    safest,
    validate,
    validation_csv,
    validation_figures,
    validation_section,
)
from hilbo.simulation.presets import PRESETS
from hilbo.simulation.validation_sessions import sets_table, validation_table
from hilbo.study.analysis.best_mid_worst import Sets

COLUMNS = ["participant", "trial", "set_a", "set_b", "class_a", "class_b", "preferred"]


def test_validate_writes_the_papers_tables(capsys, monkeypatch, tmp_path):
    table, out = tmp_path / "validation.csv", tmp_path / "results"
    paper_counts(np.random.default_rng(1)).to_csv(table, index=False)
    arguments = ["validate", table, "--study", "hilbo/data/paper.toml", "--out", out]
    code, stdout, stderr = run(capsys, monkeypatch, *arguments, "--json")
    assert (code, json.loads(stdout)) == (0, json.loads((out / "result.json").read_text()))
    (foam,) = json.loads(stdout)["materials"]
    assert (foam["material"], foam["participants"], foam["comparisons"]) == ("foam", 28, 624)
    assert foam["confusion"]["best"] == {"close": 147, "similar": 11, "different": 2}
    estimates = {number: {row["term"]: row["estimate"] for row in t["rows"]} for number, t in foam["tables"].items()}
    printed = (
        estimates["II"]["Intercept"],
        estimates["III"]["Best"],
        estimates["III"]["Worst"],
        estimates["IV"]["Aggregate-Best"],
    )
    assert [round(v, 4) for v in printed] == [-2.5123, -4.1431, 2.9738, 0.9773]
    page = " ".join((out / "report.html").read_text().split())
    assert page.count("data:image/png;base64,") == 2 and "http" not in page
    assert all(text in page for text in ("-2.5123", "4.9378", "-4.1431", "2.9738", "0.9773", "report the larger"))
    assert pd.read_csv(out / "aggregate_best_people.csv")["wins"].sum() == 279
    assert run(capsys, monkeypatch, *arguments)[0] == 2  # nothing is overwritten
    assert "below the iid ones" in stderr


def test_validate_refuses_in_one_sentence(capsys, monkeypatch, tmp_path):
    table = tmp_path / "validation.csv"
    table.write_text("participant,trial,set_a,set_b,class_a,class_b,preferred\nA,1,best,mid,splendid,similar,a\n")
    code, _, stderr = run(
        capsys, monkeypatch, "validate", table, "--study", "hilbo/data/paper.toml", "--out", tmp_path / "o"
    )
    assert code == 2 and 'validation.csv:2: class_a is "splendid"' in stderr
    assert [path.name for path in tmp_path.iterdir()] == ["validation.csv"]


def test_what_one_comparison_can_say():
    table = pd.DataFrame([("A", 1, "best", "mid", "close", "different", "a")], columns=COLUMNS)
    validated = validate(table)
    assert validated.overall is None and validated.people is None
    assert any("Table III is missing" in text for text in validated.tables.limits)
    rows = safest(validated.regressions()["II"]).set_index("term")
    assert np.isposinf(rows.at["Best", "estimate"]) and np.isfinite(rows.at["Best", "low"])


@pytest.mark.parametrize(("people", "few"), [(9, True), (14, False)])
def test_what_is_shown_is_what_the_warning_says_to_report(people, few):
    """The widest interval of all kinds of errors; few clusters are warned about."""
    answers = paper_counts(np.random.default_rng(1))
    names = answers["participant"].unique()[:people]
    table = validate(answers[answers["participant"].isin(names)]).regressions()["II"]
    assert any("report the widest interval" in words for words in table.warnings) == few
    widest = (table.table["high"] - table.table["low"]).groupby(table.table["term"]).max()
    rows = safest(table).set_index("term")
    np.testing.assert_array_equal(rows["high"] - rows["low"], widest[rows.index])


def test_ties_are_kept_apart():
    validated = validate(paper_counts(np.random.default_rng(4), ties=20))
    assert validated.people["ties"].sum() == 20 and validated.people["wins"].sum() == 279
    assert validated.overall["rate"].iloc[0] == pytest.approx(279 / 364)


@pytest.mark.parametrize(("ties", "words"), [(0, "Binary logit"), (20, "Ordered logit with ties")])
def test_table_iv_is_called_what_it_is(ties, words):
    """And its probability is nearer to one half than the share of the decided comparisons, where there are ties."""
    answers = paper_counts(np.random.default_rng(4), ties=ties)
    validated = validate(answers[answers["session"] == "aggregate-best"])
    section = validation_section(validated) | {"figures": {}}
    content = {"study": "", "seed": 0, "versions": {}}
    page = rendered("validation.html", study=plain(), content=content, warnings=[], sections=[section])
    caption = " ".join(re.search(r"preferred to the individual sets.*?</caption>", page, re.DOTALL).group().split())
    assert words in caption and "table_IV.csv" in caption and ("nearer to one half" in caption) == (ties > 0)
    row = safest(validated.tables.table_4).set_index("term").loc["Aggregate-Best"]
    probability, share = 1 / (1 + np.exp(-row["estimate"])), validated.overall["rate"].iloc[0]
    assert 0.5 < probability < share - 0.003 if ties else probability == pytest.approx(share)


def test_a_pair_that_was_only_tied_is_drawn():
    rows = [("A", 1, "best", "mid", "close", "similar", "tie"), ("A", 2, "mid", "worst", "similar", "different", "a")]
    rows += [("B", 1, "mid", "worst", "similar", "different", "b")]
    table = pd.DataFrame(rows, columns=COLUMNS)
    assert set(validation_figures(validate(table))) == {"validation"}


def test_words():
    assert [p_words(p) for p in (0.0004, 0.0312, np.nan)] == ["< 0.001", "0.031", "–"]


def test_each_material_has_a_folder_of_its_own():
    names = ["Medium (soft) silicone", "gel", "foam A", "foam-a", "Gel", "…", "foam a 2"]
    folders = ["medium-soft-silicone", "gel", "foam-a", "foam-a-2", "gel-2", "material", "foam-a-2-2"]
    assert list(folder_names(names).values()) == folders


def test_simulated_judges_prefer_what_is_nearer():
    study = Study.load("hilbo/data/paper.toml")
    truth = np.array([5.70, 5.89, 0.203])
    near = study.space.to_unit(truth)
    x = jnp.stack([jnp.asarray(near), jnp.asarray(near) + 0.1, jnp.array([0.05, 0.95, 0.9])])
    sets = sets_table(study, Sets(x, jnp.zeros(3), jnp.ones(3)), np.asarray(x)[2:])
    code = sets["source"].iloc[3].removeprefix("individual:")
    assert (
        sets["set_id"].tolist() == ["best", "mid", "worst", f"own-{code}"]
        and code.startswith("s")
        and sets["N"].eq(101).all()
    )
    validated = validate(validation_table(study, PRESETS["paper"], sets, seed=3), sets.set_index("set_id"))
    rates = validated.tables.preferences.drop_duplicates(["set", "over"]).set_index(["set", "over"])["rate"]
    assert rates["best", "worst"] > 0.8 and rates["mid", "worst"] > 0.8 and validated.comparisons == 20 * 12 + 8 * 2


@pytest.mark.parametrize("answers", [("liquid", "half", "set"), ("set_1", "class", "set"), ("index", "tie", "low_end")])
def test_an_answer_may_have_any_label(answers):
    """One of gelatin is "set", as the column of the sets is called."""
    low, middle, high = answers
    rows = [(f"V{i}", 1, "best", "mid", high, middle, "a") for i in range(3)]
    rows += [(f"V{i}", 2, "mid", "worst", middle, low if i else high, "b") for i in range(3)]
    counts = validation_csv(validate(pd.DataFrame(rows, columns=COLUMNS), responses=answers))["confusion"]
    assert counts.columns.is_unique and counts.iloc[:, 0].tolist() == ["best", "mid", "worst"]
    assert counts[high].tolist() == [3, 0, 1] and counts[middle].tolist() == [0, 6, 0]
    study = Study.from_dict(PLAIN | {"study": {"name": "gelatin", "responses": list(answers)}})
    words = dictionary({"confusion": counts}, study).set_index("column")["meaning"]
    assert words[high] == f'in which the response was "{high}"' and words.iloc[0].startswith("set that was presented")
