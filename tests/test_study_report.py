"""`hilbo validate` and `hilbo report`: what they write, what they say of poor data, and bad folders in one sentence."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace

import arviz as az
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from commands import run
from test_statistics import study as paper_counts
from test_validation import plain

from hilbo import Trials
from hilbo.analysis import Progress, _counts, analyse, limits_of, settled
from hilbo.errors import InputError
from hilbo.hypotheses import Evidence, Hypothesis, _convergence, _materials
from hilbo.inference_data import groups, predictive_shares, write_groups
from hilbo.paper_tables import aggregate_comparisons
from hilbo.plotting_study import individual_convergence
from hilbo.population_rules import RuleMap
from hilbo.report_figures import comparison_figures
from hilbo.report_study import _comparison, _shown, _tolerances
from hilbo.report_validation import p_words, safest, slug, validate, validation_figures
from hilbo.sensitivity import tolerance_ends
from hilbo.simulate import PRESETS
from hilbo.simulate_validation import sets_table, validation_table
from hilbo.study import Cohort, fit_cohort, population
from hilbo.study_folder import read_folder
from hilbo.validation import Sets, tolerance

STUDY = Path("hilbo/data/paper.toml").read_text()
HEAD = "participant,trial,response,K1,B1,alpha\n"


def crowd(answers):
    """A cohort of the plain study (two parameters) with these lists of (u, v, category)."""
    longest = max(map(len, answers))
    stacked = []
    for rows in answers:
        x, q = np.array([row[:2] for row in rows]).reshape(-1, 2), np.array([row[2] for row in rows], int)
        stacked.append(Trials.from_arrays(x, q, longest))
    trials = jax.tree.map(lambda *leaves: jnp.stack(leaves), *stacked)
    physical = np.asarray(plain().space.to_physical(trials.x))
    return Cohort(trials, physical, tuple(f"P{j}" for j in range(len(answers))))


HILL = [(u, v, 2 - (abs(u - 0.4) > 0.2) - (abs(v - 0.5) > 0.25)) for u in (0.1, 0.4, 0.7) for v in (0.1, 0.5, 0.9)]


# hilbo validate


def test_validate_writes_the_papers_tables(capsys, monkeypatch, tmp_path):
    table, out = tmp_path / "validation.csv", tmp_path / "results"
    paper_counts(np.random.default_rng(1)).to_csv(table, index=False)
    arguments = ["validate", table, "--study", "hilbo/data/paper.toml", "--out", out]
    code, stdout, stderr = run(capsys, monkeypatch, *arguments, "--json")
    assert (code, json.loads(stdout)) == (0, json.loads((out / "result.json").read_text()))
    (foam,) = json.loads(stdout)["materials"]
    assert (foam["material"], foam["participants"], foam["comparisons"]) == ("foam", 28, 624)
    assert foam["confusion"]["best"] == {"close": 147, "similar": 11, "different": 2}
    found = {number: {row["term"]: row["estimate"] for row in t["rows"]} for number, t in foam["tables"].items()}
    printed = (found["II"]["Intercept"], found["III"]["Best"], found["III"]["Worst"], found["IV"]["Aggregate-Best"])
    assert [round(v, 4) for v in printed] == [-2.5123, -4.1431, 2.9738, 0.9773]
    page = (out / "report.html").read_text()
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
    columns = ["participant", "trial", "set_a", "set_b", "class_a", "class_b", "preferred"]
    table = pd.DataFrame([("A", 1, "best", "mid", "close", "different", "a")], columns=columns)
    found = validate(table)
    assert found.overall is None and found.people is None
    assert any("Table III is missing" in text for text in found.tables.limits)
    rows = safest(found.regressions()["II"]).set_index("term")
    assert np.isposinf(rows.at["Best", "estimate"]) and np.isfinite(rows.at["Best", "low"])


@pytest.mark.parametrize(("people", "few"), [(9, True), (14, False)])
def test_what_is_shown_is_what_the_warning_says_to_report(people, few):
    """Of few clusters the wider of the clustered and the wild bootstrap interval, as the table's own warning has it."""
    answers = paper_counts(np.random.default_rng(1))
    names = answers["participant"].unique()[:people]
    table = validate(answers[answers["participant"].isin(names)]).regressions()["II"]
    assert any("wild bootstrap interval" in words for words in table.warnings) == few
    kinds = table.table[few | ~table.table["errors"].str.startswith("wild")]
    widest = (kinds["high"] - kinds["low"]).groupby(kinds["term"]).max()
    rows = safest(table).set_index("term")
    np.testing.assert_array_equal(rows["high"] - rows["low"], widest[rows.index])
    assert rows["errors"].str.startswith("wild").any() == few


def test_ties_are_kept_apart():
    found = validate(paper_counts(np.random.default_rng(4), ties=20), bootstrap=False)
    assert found.people["ties"].sum() == 20 and found.people["wins"].sum() == 279
    assert found.overall["rate"].iloc[0] == pytest.approx(279 / 364)


def test_words():
    assert [p_words(p) for p in (0.0004, 0.0312, np.nan)] == ["< 0.001", "0.031", "–"]
    assert slug("Medium (soft) silicone") == "medium-soft-silicone"


# What poor data can say


def test_limits_are_named():
    study = plain()
    found = limits_of(study, crowd([HILL, HILL[:2], [(0.1, 0.1, 0)] * 6]))
    assert found[0].startswith("Fewer than 5 answers were given by P1")
    assert "between 2 and 9" in found[1] and 'P2 ("different")' in found[2]
    assert "plans 25 trials; nobody has given more than 9" in found[3]
    assert limits_of(study, crowd([HILL]))[0].startswith(
        "P0 is the only participant: the population map is that person's own,"
    )
    shrunk = limits_of(dataclasses.replace(study, rule="rbcm"), crowd([HILL]))[0]
    assert "own, shrunk towards the prior, and nothing" in shrunk


@pytest.mark.parametrize(
    ("errors", "expected"), [([0.5, 0.2, 0.04, 0.01, 0], 3), ([0.5, 0.5, 0.5, 0.5, 0], None), ([0.0] * 5, 1)]
)
def test_when_an_optimum_has_settled(errors, expected):
    assert settled(np.arange(1, 6), np.array(errors, float)) == expected


def test_who_stopped_early_has_not_converged_for_that():
    """One moves until the end, one stays from trial 2 on, and one stops after a trial or two, still moving."""
    ways = np.array([[0, 1, 2, 3, 4, 5], [0, 5, 5, 5, 5, 5], [0, 5, 5, 5, 5, 5]]).T / 10
    progress = Progress(np.arange(1, 7), ways[:, 1:2], ways[:, :, None], np.array([6, 6, 2]))
    assert progress.settled(0.05) == [None, 2, None]
    assert np.isnan(progress.to_end()[1][2:, 2]).all() and np.isfinite(progress.to_end()[1][:, :2]).all()
    assert set(_counts(crowd([HILL, HILL[:4], HILL[:7]]))) >= {4, 5, 7, 9}
    (line,) = individual_convergence(plain(), crowd([HILL, HILL, HILL[:2]]), progress).axes[0].lines
    np.testing.assert_allclose(line.get_ydata(), [50, 0, 15, 10, 5, 0], atol=1e-12)
    one = jnp.ones(())
    aggregate = SimpleNamespace(map=RuleMap("bcm", "by points", None, None, one, one))
    for end, words in ((2, "1 of 3 individual optima"), (1, "1 of 2 individual optima")):
        found = SimpleNamespace(
            progress=progress._replace(ends=np.array([6, 6, end])),
            cohort=SimpleNamespace(names=("A", "B", "C")),
            aggregate=aggregate,
        )
        (item,) = _convergence(SimpleNamespace(found=found, reference=None))
        assert item.side == "for" and words in item.text and "(for: one at least)" in item.text


def test_other_materials_are_the_others():
    """H1 to H3 are of the first material, and its figures are no evidence for H4."""
    study, validated = plain(), validate(paper_counts(np.random.default_rng(4), ties=20), bootstrap=False)
    optimum, own = SimpleNamespace(x=jnp.array([0.5, 0.5])), SimpleNamespace(x=jnp.array([[0.1, 0.5], [0.9, 0.5]]))
    found = SimpleNamespace(study=study, aggregate=SimpleNamespace(optimum=optimum, individuals=own))
    parts = {"found": found, "reference_name": "the truth"}
    first, second, third = (
        SimpleNamespace(name=name, validated=asked, reference=reference, **parts)
        for name, asked, reference in (("A", None, np.zeros(2)), ("B", validated, np.full(2, 0.5)), ("C", None, None))
    )
    items = list(_materials([first, second, third]))
    assert [item.text[0] for item in items] == ["B", "B", "C"] and [i.side for i in items] == ["for", "for", "open"]
    assert items[0].text.endswith("(for: nearer than that).")
    assert "76.6 % of the decided comparisons (20 ties;" in items[1].text
    assert [item.side for item in _materials([first])] == ["open"]


def test_measures_have_the_digits_that_answers_give():
    head, rows = _shown(pd.DataFrame({"lapse_low": [0.12345], "trials": [25], "drift_high": [np.inf]}), digits=2)
    assert (head, rows) == (["lapse low", "trials", "drift high"], [["0.12", "25", "∞"]])
    row = dict(hyperparameters="fixed", parameter="u", draws_without=0.0, low_end="range", high_end="range")
    row |= dict(low=1.0, high=12.346, low_from=1.0, low_to=1.2346, high_from=1.1, high_to=12.346)
    _, ((*_, low, ends, _),) = _tolerances(pd.DataFrame([row]))
    assert (low, ends) == ("12.35 (range)", "1.1 to 12")


def test_verdicts_count_what_can_be_said():
    def verdict(*sides):
        return Hypothesis("H1", "", tuple(Evidence(side, "") for side in sides)).verdict

    assert verdict("open") == "These data cannot say."
    assert verdict("for", "open", "for") == "All that can be said (2 of 2) speaks for it."
    assert verdict("for", "against", "open") == "1 of 2 items speak for it, 1 against."


class Population(eqx.Module):
    posteriors: object

    def __call__(self, x):
        return population(self.posteriors, x)


@pytest.mark.deep
def test_one_persons_tolerance_does_not_depend_on_the_draw():
    """With one participant every bootstrap draw is the same map, and the ends are those of the exact interval."""
    study, cohort = plain(), crowd([HILL * 3])
    posteriors, x = fit_cohort(study, cohort), jnp.array([0.4, 0.5])
    exact = tolerance(study, Population(posteriors), x, "v")
    ends = tolerance_ends(study, posteriors, x, "v", draws=5)
    assert ends.lost == 0.0 and ends.low[0] == ends.low[1] and ends.high[0] == ends.high[1]
    width = 10 / 256  # of the grid, in the parameter's unit
    assert 0 <= ends.low[0] - exact.low < 1.01 * width and 0 <= exact.high - ends.high[0] < 1.01 * width
    two = crowd([HILL * 3, [(u, v, 0) for u, v, _ in HILL] * 3])
    spread = tolerance_ends(study, fit_cohort(study, two), x, "v", draws=50)
    assert spread.lost > 0.1  # draws of the second person alone have no interval


def test_groups_are_what_arviz_reads(tmp_path):
    study, cohort = plain(), crowd([HILL, HILL[:4]])
    posteriors = fit_cohort(study, cohort)
    found = groups(study, cohort, posteriors, draws=4000)
    f = found["posterior"]["f"].values[0]
    mean, variance = posteriors_at(posteriors)
    np.testing.assert_allclose(f[:, 0].mean(axis=0), mean[0], atol=0.06)
    np.testing.assert_allclose(f[:, 0].var(axis=0), variance[0], atol=0.06)
    assert np.isnan(f[:, 1, 4:]).all() and (found["observed_data"]["response"].values[1, 4:] == -1).all()
    observed, predicted = predictive_shares(found, 3)
    assert observed.sum() == pytest.approx(1.0) and predicted.shape == (4000, 3)
    write_groups(found, tmp_path / "inference.nc")
    read = az.from_netcdf(tmp_path / "inference.nc", engine="h5netcdf")
    assert {"posterior", "posterior_predictive", "observed_data", "log_likelihood", "constant_data"} <= set(
        read.groups()
    )
    tree = xr.open_datatree(tmp_path / "inference.nc", engine="h5netcdf")
    np.testing.assert_array_equal(tree["constant_data"]["u"].values[0], cohort.physical[0, :, 0])
    tree.close()


def posteriors_at(posteriors):
    def one(posterior):
        return posterior.predict(posterior.trials.x)

    return tuple(np.asarray(part) for part in jax.lax.map(one, posteriors))


def test_simulated_judges_prefer_what_is_nearer():
    from hilbo import Study

    study = Study.load("hilbo/data/paper.toml")
    truth = np.array([5.70, 5.89, 0.203])
    near = study.space.to_unit(truth)
    x = jnp.stack([jnp.asarray(near), jnp.asarray(near) + 0.1, jnp.array([0.05, 0.95, 0.9])])
    sets = sets_table(study, Sets(x, jnp.zeros(3), jnp.ones(3)), np.asarray(x)[2:], ("P01",))
    assert sets["set_id"].tolist() == ["best", "mid", "worst", "own-P01"] and sets["N"].eq(101).all()
    found = validate(validation_table(study, PRESETS["paper"], sets, seed=3), sets.set_index("set_id"), bootstrap=False)
    rates = found.tables.preferences.drop_duplicates(["set", "over"]).set_index(["set", "over"])["rate"]
    assert rates["best", "worst"] > 0.8 and rates["mid", "worst"] > 0.8 and found.comparisons == 20 * 12 + 8 * 2


# Folders


def folder_with(tmp_path, **files):
    folder = tmp_path / "folder"
    folder.mkdir()
    for name, text in ({"study.toml": STUDY} | {k.replace("__", "."): v for k, v in files.items()}).items():
        (folder / name).write_text(text)
    return folder


ROW = "A,1,close,5,6,0.2\n"
BAD = {
    "no trials": ({}, "holds no trials.csv"),
    "the same answer twice": ({"trials__csv": HEAD + ROW, "trials-2__csv": HEAD + ROW}, "is in two trial tables"),
    "another parameter": (
        {"trials__csv": "participant,trial,response,K1,B1\nA,1,close,5,6\n"},
        'column "alpha" is missing',
    ),
    "another answer": ({"trials__csv": HEAD + "A,1,superb,5,6,0.2\n"}, 'response is "superb"'),
    "half of the materials": (
        {"trials__csv": HEAD + ROW, "trials-2__csv": "material," + HEAD + "foam,B,1,close,5,6,0.2\n"},
        "some rows name a material",
    ),
    "two truths": (
        {"trials__csv": HEAD + ROW, "truth__csv": "source,K1,B1,alpha\npopulation,5,6,0.2\npopulation,5,6,0.3\n"},
        'there are 2 sets of source "population"',
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_folders_are_refused_in_one_sentence(capsys, monkeypatch, tmp_path, what):
    files, words = BAD[what]
    code, _, stderr = run(capsys, monkeypatch, "report", folder_with(tmp_path, **files), "--out", tmp_path / "out")
    assert code == 2 and words in stderr
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]


def test_the_report_never_replaces_what_it_reads(capsys, monkeypatch, tmp_path):
    folder = folder_with(tmp_path, trials__csv=HEAD + ROW)
    for out in (folder, tmp_path):
        code, _, stderr = run(capsys, monkeypatch, "report", folder, "--out", out, "--force")
        assert code == 2 and "holds the folder that is read" in stderr
    code, _, stderr = run(capsys, monkeypatch, "report", tmp_path / "none", "--out", tmp_path / "out")
    assert code == 2 and "is no folder" in stderr
    other = folder_with(tmp_path / "folder", trials__csv=HEAD + ROW)
    code, _, stderr = run(
        capsys,
        monkeypatch,
        "validate",
        folder / "trials.csv",
        "--study",
        folder / "study.toml",
        "--out",
        other,
        "--force",
    )
    assert code == 2 and "is not a result of hilbo's" in stderr  # data without a result beside it


def test_materials_have_their_own_references(tmp_path):
    text = STUDY + "\n[materials.soft.renderer]\nK_eff = 0.3\n"
    trials = "material," + HEAD + "soft,A,1,close,5,6,0.2\nhard,A,1,different,4,6,0.2\n"
    with pytest.raises(InputError, match='material "hard" is not in the study file'):
        read_folder(folder_with(tmp_path, study__toml=text, trials__csv=trials))
    folder = tmp_path / "folder"
    (folder / "study.toml").write_text(text + "[materials.hard]\n")
    (folder / "truth.csv").write_text("source,material,K1,B1,alpha\npopulation,soft,5,6,0.2\npopulation,hard,8,6,0.2\n")
    found = read_folder(folder)
    assert [m.name for m in found.materials] == ["soft", "hard"] and len(found.limits) == 1
    soft, hard = found.materials
    assert soft.study.space.mechanics.K_eff == 0.3 and hard.study.space.mechanics.K_eff == 0.44
    np.testing.assert_allclose([m.reference[0] for m in (soft, hard)], [4 / 31, 7 / 31])
    strict = read_folder(folder, "trials < 5").materials[0]
    with pytest.raises(InputError, match="leaves out all 1"):
        analyse(strict.study, strict.cohort)


VALIDATION = "participant,trial,set_a,set_b,class_a,class_b,preferred\n"


def test_two_validation_tables_are_read_as_one(tmp_path):
    row = "{},1,aggregate,individual:B,close,different,{}\n"
    first, second = (VALIDATION + row.format(*cells) for cells in (("A", "a"), ("B", "b")))
    folder = folder_with(tmp_path, trials__csv=HEAD + ROW, **{"validation-1__csv": first, "validation-2__csv": second})
    (material,) = read_folder(folder).materials
    found = validate(material.validation, bootstrap=False)
    assert found.people["wins"].tolist() == [1, 0] and found.comparisons == 2
    twice = aggregate_comparisons(
        pd.concat([material.validation] * 2), {"aggregate": "aggregate", "individual:B": "individual:B"}
    )
    assert len(twice) == 4


def test_a_pair_that_was_only_tied_is_drawn():
    rows = [("A", 1, "best", "mid", "close", "similar", "tie"), ("A", 2, "mid", "worst", "similar", "different", "a")]
    rows += [("B", 1, "mid", "worst", "similar", "different", "b")]
    table = pd.DataFrame(rows, columns=VALIDATION.strip().split(","))
    assert set(validation_figures(validate(table, bootstrap=False))) == {"validation"}


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("validation", VALIDATION + "A,1,best,mid,close,similar,a\n"),
        ("sets", "set_id,source,K1,B1,alpha\nsysid,sysid,5,6,0.2\n"),
        ("truth", "source,K1,B1,alpha\npopulation,5,6,0.2\n"),
        ("truth", "source,material,K1,B1,alpha\npopulation,soft,5,6,0.2\npopulation,,5,6,0.2\n"),
    ],
)
def test_what_is_of_no_material_is_not_taken_for_all(tmp_path, file, text):
    trials = "material," + HEAD + "soft,A,1,close,5,6,0.2\nhard,A,1,different,4,6,0.2\n"
    folder = folder_with(tmp_path, trials__csv=trials, **{f"{file}__csv": text})
    with pytest.raises(InputError, match=f"{file}.csv: rows without a material.*this study has soft, hard"):
        read_folder(folder)


@pytest.mark.deep
def test_a_report_of_two_materials(capsys, monkeypatch, tmp_path):
    table = pd.read_csv("hilbo/data/video_quality.csv", dtype=str)
    table = table[table["participant"].isin(["V01", "V02", "V03", "V04"])].groupby("participant").head(15)
    table["material"] = np.where(table["participant"].isin(["V01", "V02"]), "one", "two")
    folder, out = tmp_path / "folder", tmp_path / "out"
    folder.mkdir()
    (folder / "study.toml").write_text(Path("hilbo/data/video_quality.toml").read_text())
    table.to_csv(folder / "trials.csv", index=False)
    pair = "participant,material,trial,set_a,set_b,class_a,class_b,preferred\n"
    (folder / "validation.csv").write_text(pair + "".join(f"N{i},one,1,best,worst,good,bad,a\n" for i in range(4)))
    code, stdout, _ = run(capsys, monkeypatch, "report", folder, "--out", out, "--exclude", "trials < 9", "--json")
    assert code == 0
    content = json.loads(stdout)
    assert set(content["materials"]) == {"one", "two"} and "validation" in content["materials"]["one"]
    assert [h["number"] for h in content["hypotheses"]] == ["H1", "H2", "H3", "H4"]
    assert "No validation session compared renderings of two." in content["limits"]
    for name in ("one", "two"):
        for file in (
            "table_I.csv",
            "convergence.csv",
            "tolerance.csv",
            "people.csv",
            "passivity.csv",
            "inference.nc",
            "map.nc",
        ):
            assert (out / name / file).stat().st_size
        assert all((out / name / f"classes.{kind}").stat().st_size for kind in ("png", "svg"))
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 2 * 9 + 1 and "http://" not in page
    assert "Hypothesis 4" in page and "fair, good, excellent" in page
    assert run(capsys, monkeypatch, "report", folder, "--out", out, "--force", "--exclude", "mood > 1")[0] == 2


def test_the_comparison_of_rules_is_shown():
    """From the content of `comparison.compare`: a row for each rule, refused ones too, and two figures."""
    scores = {
        "negative_log_density": 1.1,
        "negative_log_density_error": 0.1,
        "central_95": 0.94,
        "central_95_error": 0.01,
    }
    bins = [{"predicted": 0.1, "observed": 0.2}, {"predicted": 0.8, "observed": 0.7}]
    found = scores | {
        "method": "by points",
        "z2": 1.2,
        "covered": 0.5,
        "optimum_sd": 0.2,
        "optimum": {"u": 0.4, "v": 12.0},
    }
    found |= {"influence": {"A": 0.1, "B": 0.3}, "reliability": bins}
    content = {
        "rules": {"bcm": found, "hierarchical": found, "pooled": {"refused": "too many"}},
        "recommendation": "Use bcm.",
    }
    shown = _comparison(content)
    head, rows = shown["table"]
    assert (
        shown["words"] == "Use bcm."
        and head[0] == "rule"
        and [row[0] for row in rows] == ["bcm", "hierarchical", "pooled"]
    )
    assert "too many" in rows[2] and "–" in rows[2]
    figures = comparison_figures(content)
    assert set(figures) == {"comparison", "reliability"} and len(figures["comparison"][0].axes) == 2
