"""`hilbo report`: what it says of poor data and of the hypotheses, its tables, its figures and its page."""

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
from studies import PLAIN, paper_counts, plain

from hilbo import Study, Trials
from hilbo.population.maps import RuleMap
from hilbo.population.rules.registry import RULES
from hilbo.report.figures.people import people_figure
from hilbo.report.figures.progress import individual_convergence
from hilbo.report.study.comparison import comparison_section
from hilbo.report.study.hypotheses import _convergence, _materials, _nearer_to_others
from hilbo.report.study.page_tables import alternatives_rows, measures_rows, tolerance_rows
from hilbo.report.study.study_figures import comparison_figures
from hilbo.report.validation import validate
from hilbo.search.box import Parameter
from hilbo.study.analysis.analysis import limits_of
from hilbo.study.analysis.progress import Progress, _counts, _splits, _to_other_half
from hilbo.study.analysis.tolerance import tolerance, tolerance_ends
from hilbo.study.cohort import Cohort, cohort_of
from hilbo.study.estimate.aggregate import fit_cohort
from hilbo.study.estimate.bootstrap import can_resample
from hilbo.study.estimate.optimum import predict_people
from hilbo.study.file.reserved_names import is_reserved
from hilbo.study.folder import Reference
from hilbo.study.results.arviz_groups import groups, predictive_shares, write_groups
from hilbo.study.template import NewStudy, study_text


def crowd(answers):
    """A cohort of the plain study (two parameters) with these lists of (u, v, category)."""
    longest = max(map(len, answers))
    stacked = []
    for rows in answers:
        x, q = np.array([row[:2] for row in rows]).reshape(-1, 2), np.array([row[2] for row in rows], int)
        stacked.append(Trials.from_arrays(x, q, longest))
    trials = jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *stacked)
    physical = np.asarray(plain().space.to_physical(np.asarray(trials.x)))
    return Cohort(trials, physical, tuple(f"P{j}" for j in range(len(answers))))


HILL = [(u, v, 2 - (abs(u - 0.4) > 0.2) - (abs(v - 0.5) > 0.25)) for u in (0.1, 0.4, 0.7) for v in (0.1, 0.5, 0.9)]


def test_limits_are_named():
    study = plain()
    limits = limits_of(study, crowd([HILL, HILL[:2], [(0.1, 0.1, 0)] * 6]))
    assert limits[0].startswith("Fewer than 5 responses are from P1")
    assert "between 2 and 9" in limits[1] and 'P2 ("different")' in limits[2]
    assert "plans 25 trials; the largest number of responses is 9" in limits[3]
    assert limits_of(study, crowd([HILL]))[0].startswith(
        "P0 is the only participant: the population map is that participant's,"
    )


def test_limits_name_twenty_participants_and_count_the_others():
    few, one = limits_of(plain(), crowd([HILL[:1]] * 1023))[:2]
    assert "P0, P1" in few and "P19 and 1,003 more; their maps" in few and "P20" not in few + one
    assert one.endswith('P19 ("different") and 1,003 more: such maps have no direction of improvement.')


def test_halves_share_nobody_and_people_are_held_against_the_half_without_them():
    split = _splits(5, 0)
    assert split.shape == (50, 5) and (split.sum(axis=1) == 2).all() and not len(_splits(3, 0))
    tops = np.array([[[[0.0], [1.0]]], [[[0.2], [0.6]]]])  # after two numbers of trials, one split, two halves
    halves, own = _to_other_half((), tops, np.array([[[0.1], [0.1]], [[0.3], [0.5]]]), np.array([[True, False]]))
    np.testing.assert_allclose(halves, [[0.6, 0.8], [0.4, 0.4]])
    np.testing.assert_allclose(own, [[0.5, 0.1], [0.3, 0.3]])  # the first person is in the first half
    none, nan = _to_other_half((), tops[:, :0], np.zeros((2, 3, 1)), np.zeros((0, 3), bool))
    assert none.shape == (2, 0) and np.isnan(nan).all()


def test_who_stopped_early_has_not_converged_for_that():
    """One moves until the end, one stays from trial 2 on, and one stops after a trial or two, still moving."""
    ways = np.array([[0, 1, 2, 3, 4, 5], [0, 5, 5, 5, 5, 5], [0, 5, 5, 5, 5, 5]]).T / 10
    halves, own = np.full((6, 4), 0.1), np.full((6, 3), 0.2)
    progress = Progress(np.arange(1, 7), ways[:, 1:2], ways[:, :, None], np.array([6, 6, 2]), halves, own, {})
    assert np.isnan(progress.to_end()[1][2:, 2]).all() and np.isfinite(progress.to_end()[1][:, :2]).all()
    assert set(_counts(crowd([HILL, HILL[:4], HILL[:7]]).counts())) >= {4, 5, 7, 9}
    line, others = individual_convergence(plain(), crowd([HILL, HILL, HILL[:2]]), progress).axes[0].lines
    np.testing.assert_allclose(line.get_ydata(), [50, 0, 15, 10, 5, 0], atol=1e-12)
    np.testing.assert_allclose(others.get_ydata(), 20)


def test_convergence_is_judged_by_people_who_are_not_among_them():
    """Not by a study's own last point, to which everything comes, random answers too."""
    one = jnp.ones(())
    aggregate = SimpleNamespace(map=RuleMap("bcm", "by points", None, None, one, one))
    still, apart = np.zeros((6, 3, 1)), np.array([[0.0, 0.01, -0.01]] * 6)
    for halves, own, side in ((0.1, 0.2, "supports"), (0.3, 0.2, "contradicts")):
        progress = Progress(
            np.arange(1, 7), still[:, 0], still, np.full(3, 6), np.full((6, 4), halves), own + apart, {}
        )
        analysis = SimpleNamespace(progress=progress, aggregate=aggregate)
        (item,) = _convergence(SimpleNamespace(analysis=analysis, reference=None))
        assert item.side == side and f"{100 * halves:.0f} % (NRMSE, median of 4" in item.text
    own = np.linspace(0.5, 0.2, 6)[:, None] * np.array([1.0, 1.02, 0.98])
    assert _nearer_to_others(progress._replace(individual_to_half=own)).side == "supports"
    assert _nearer_to_others(progress._replace(individual_to_half=own[::-1])).side == "contradicts"
    random = np.random.default_rng(0).uniform(size=(6, 3))
    assert _nearer_to_others(progress._replace(individual_to_half=random)).side == "inconclusive"


def test_other_materials_are_the_others():
    """H1 to H3 are of the first material, and its figures are no evidence for H4."""
    study, validated = plain(), validate(paper_counts(np.random.default_rng(4), ties=20))
    optimum, own = SimpleNamespace(x=jnp.array([0.5, 0.5])), SimpleNamespace(x=jnp.array([[0.1, 0.5], [0.92, 0.5]]))
    analysis = SimpleNamespace(study=study, aggregate=SimpleNamespace(optimum=optimum, individuals=own))
    parts = {"analysis": analysis}
    first, second, third = (
        SimpleNamespace(name=name, validated=asked, reference=reference, **parts)
        for name, asked, reference in (
            ("A", None, Reference(np.zeros(2), "the truth")),
            ("B", validated, Reference(np.full(2, 0.5), "the truth")),
            ("C", None, None),
        )
    )
    items = list(_materials([first, second, third]))
    near, *staged, preferred, nothing = items
    assert [item.text[0] for item in items] == [*"B" * (len(items) - 1), "C"] and nothing.side == "inconclusive"
    assert near.side == preferred.side == "supports"
    tables = [item.text.split(",")[0] for item in staged]
    assert tables[-3:] == ["B: Table II", "B: Table III", "B: Table III"]
    assert items[0].text.endswith("on average (supports: an interval above 0).")
    assert "76.6 % of the decided comparisons (20 ties;" in preferred.text
    assert [item.side for item in _materials([first])] == ["inconclusive"]


def test_measures_have_the_digits_that_answers_give():
    people = {"trials": [25], "lapse": [0.1234], "lapse_low": [0.0], "lapse_high": [0.456], "drift_high": [np.inf]}
    head, rows = measures_rows(pd.DataFrame(people))
    assert (head, rows) == (list(people), [["25", "0.12", "0.00", "0.46", "∞"]])
    row = dict(hyperparameters="fixed", parameter="u", draws_without=0.0, low_end="range", high_end="range")
    row |= dict(low=1.0, high=12.346, low_from=1.0, low_to=1.2346, high_from=1.1, high_to=12.346)
    ((*_, low, ends, without),) = tolerance_rows(plain(), pd.DataFrame([row]))
    assert (low, ends, without) == ("12 (range)", "1 to 12", "0")


def test_what_is_not_known_of_somebody_is_a_line_without_a_mark():
    people = pd.DataFrame(
        {
            "participant": ["left out", "kept"],
            **{"consistency": [0.5, np.nan], "consistency_low": [0.1, 0.0], "consistency_high": [0.9, 1.0]},
            **{"lapse": [np.nan, 0.0], "lapse_low": [0.0, 0.0], "lapse_high": [1.0, 0.4]},
            **{"drift": [np.nan, 0.0], "drift_low": [-np.inf, -1.0], "drift_high": [np.inf, 2.0]},
        }
    )
    panels = people_figure(people, {"left out": "lapse > 0.3"}).axes
    for axes, marks in zip(panels, ((0, 1), (1, 0), (1, 0)), strict=True):
        kept, dots, out, crosses = axes.collections[:4]
        (line,), (of_left_out,) = kept.get_segments(), out.get_segments()
        assert np.ptp(line[:, 0]) > 0.3 and np.ptp(of_left_out[:, 0]) > 0.3
        assert (len(dots.get_offsets()), len(crosses.get_offsets())) == marks
    assert np.ptp(of_left_out[:, 0]) == np.ptp(panels[2].get_xlim())  # from one side of the panel to the other


class Population(eqx.Module):
    posteriors: object

    def __call__(self, x):
        return predict_people(self.posteriors, x)


def test_one_person_has_no_resamples():
    """All of them would be the same map, an interval of width 0."""
    study, cohort = plain(), crowd([HILL[:6], []])
    posteriors, x = fit_cohort(study, cohort), jnp.array([0.4, 0.5])
    ends = tolerance_ends(study, posteriors, x, "v", draws=5)
    assert np.isnan([*ends.low, *ends.high, ends.lost]).all()
    assert not can_resample(posteriors)
    row = dict(hyperparameters="fixed", parameter="v", draws_without=ends.lost, low_end="range", high_end="range")
    row |= dict(low=1.0, high=2.0, low_from=np.nan, low_to=np.nan, high_from=np.nan, high_to=np.nan)
    ((*_, low, low_draws, _, high_draws, without),) = tolerance_rows(plain(), pd.DataFrame([row]))
    assert (low, low_draws, high_draws, without) == ("1.00 (range)", "–", "–", "–")


@pytest.mark.deep
def test_tolerance_of_people_who_agree_does_not_depend_on_the_draw():
    """With two alike every bootstrap draw is the same map, and the ends are those of the exact interval."""
    study, cohort = plain(), crowd([HILL * 3] * 2)
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
    study, cohort = plain(), crowd([HILL[:6], HILL[:4]])
    posteriors = fit_cohort(study, cohort)
    made = groups(study, cohort, posteriors, draws=4000)
    constants = made["constant_data"]
    own = {*constants.variables, *constants.dims} - {*study.space.names}
    assert all(is_reserved(name, study.responses, False) for name in own)
    f = made["posterior"]["f"].values[0]
    mean, variance = posteriors_at(posteriors)
    np.testing.assert_allclose(f[:, :6].mean(axis=0), mean[0, :6], atol=0.06)
    np.testing.assert_allclose(f[:, :6].var(axis=0), variance[0, :6], atol=0.06)
    assert all(group.sizes["obs_id"] == 10 for group in made.values())
    given = made["log_likelihood"]["response"]
    expected = jax.jit(jax.vmap(study.gp.likelihood.log_prob))(f[0, 6:], np.asarray(cohort.trials.q)[1, :4])
    np.testing.assert_allclose(given.values[0, 0, -4:], expected)
    assert list(given["participant"].values[-5:]) == ["P0", *["P1"] * 4]
    assert list(given["answer"].values[-4:]) == [1, 2, 3, 4]
    observed, predicted = predictive_shares(made, 3)
    assert observed.sum() == pytest.approx(1.0) and predicted.shape == (4000, 3)
    write_groups(made, tmp_path / "inference.nc")
    read = az.from_netcdf(tmp_path / "inference.nc", engine="h5netcdf")
    names = read.groups() if callable(read.groups) else [path.strip("/") for path in read.groups]  # ArviZ 0 or 1
    assert {"posterior", "posterior_predictive", "observed_data", "log_likelihood", "constant_data"} <= set(names)
    with pytest.warns(UserWarning, match="Pareto"):  # four answers of somebody: each weighs much
        loo = az.loo(read)
    assert np.isfinite(getattr(loo, "elpd", None) or loo.elpd_loo)
    tree = xr.open_datatree(tmp_path / "inference.nc", engine="h5netcdf")
    np.testing.assert_array_equal(tree["constant_data"]["u"].values[:6], cohort.physical[0, :6, 0])
    tree.close()


UNEQUAL = [[*HILL, *HILL, *HILL[:7]], [*HILL[::-1], *HILL, *HILL[2:]], HILL[1:8]]  # 25, 25, 7


@pytest.fixture(scope="module")
def read_back(tmp_path_factory):
    """inference.nc of three participants with 25, 25 and 7 responses, by two methods, as ArviZ reads the files."""
    cohort, read = crowd(UNEQUAL), []
    for noise in (0.5, 0.8):
        study = Study.from_dict(PLAIN | {"gp": PLAIN["gp"] | {"noise": noise}})
        path = tmp_path_factory.mktemp("arviz") / "inference.nc"
        write_groups(groups(study, cohort, fit_cohort(study, cohort), draws=100), path)
        read.append(az.from_netcdf(path, engine="h5netcdf"))
    return read


@pytest.mark.filterwarnings("ignore")  # of few responses
def test_arviz_summarises_and_compares_unequal_numbers_of_answers(read_back):
    one, other = read_back
    observed = one.observed_data["response"].values
    shares = [np.mean(observed == k) for k in range(3)]
    assert observed.size == 57 and sum(shares) == pytest.approx(1.0, abs=1e-12) and min(shares) > 0
    assert len(az.summary(one)) == 57
    loo = az.loo(one)
    assert np.isfinite(getattr(loo, "elpd", None) or loo.elpd_loo)
    assert set(az.compare({"noise 0.5": one, "noise 0.8": other}).index) == {"noise 0.5", "noise 0.8"}


@pytest.mark.filterwarnings("ignore")  # of few answers and of matplotlib
@pytest.mark.parametrize("plot", ["plot_ppc", "plot_loo_pit", "plot_separation", "plot_bpv", "plot_khat"])
def test_arviz_draws_unequal_numbers_of_answers(plot, read_back):
    data = read_back[0]
    if plot == "plot_ppc":
        (axes,) = np.ravel(az.plot_ppc(data, kind="cumulative", show=False))
        assert min(np.min(line.get_xdata()) for line in axes.lines if len(line.get_xdata())) >= 0
    elif plot == "plot_khat":
        az.plot_khat(az.loo(data, pointwise=True))
    else:
        getattr(az, plot)(data, y="response") if plot != "plot_bpv" else az.plot_bpv(data)


def test_answers_are_found_in_the_table_by_trial_and_session(tmp_path):
    """A voided answer moves the count of the fitted ones, and not the table's numbers."""
    table = pd.DataFrame({"participant": ["A"] * 4 + ["B"] * 2, "session": ["1", "1", "1", "2", "1", "1"]})
    table = table.assign(
        trial=[1, 2, 3, 1, 5, 4], voided=[0, 1, 0, 0, 0, 0], response="close", u=np.arange(6) / 8, v=12.0
    )
    study = plain()
    cohort = cohort_of(table, study, 6)
    write_groups(groups(study, cohort, fit_cohort(study, cohort), draws=2), tmp_path / "inference.nc")
    with xr.open_dataset(tmp_path / "inference.nc", group="constant_data", engine="h5netcdf") as constants:
        frame = constants[["trial", "session", "u"]].to_dataframe().reset_index()
    joined = frame.merge(table, on=["participant", "session", "trial"], validate="one_to_one")
    assert len(joined) == 5 and (joined["u_x"] == joined["u_y"]).all()
    assert list(frame["answer"]) == [1, 2, 3, 1, 2]
    np.testing.assert_array_equal(cohort.rows(np.array([1])).numbers, [[4, 5, 0, 0, 0, 0]])


def posteriors_at(posteriors):
    def one(posterior):
        return posterior.predict(posterior.trials.x)

    return tuple(np.asarray(part) for part in jax.lax.map(one, posteriors))


@pytest.mark.deep
def test_a_report_of_one_person(capsys, monkeypatch, tmp_path):
    """By the rule that new studies have, and as of more participants than `MANY`."""
    monkeypatch.setattr("hilbo.report.results.MANY", 0)
    folder, out = tmp_path / "folder", tmp_path / "out"
    folder.mkdir()
    parameters = Parameter("u", 0.0, 1.0), Parameter("v", 0.0, 1.0)
    text = study_text(NewStudy("plain", parameters))
    (folder / "study.toml").write_text(text.replace("[study]\n", '[study]\nexclude_flags = ["slewed"]\n', 1))
    rows = {"participant": "P1", "trial": range(1, 10), "response": [plain().responses[q] for _, _, q in HILL]}
    table = pd.DataFrame(rows).assign(u=[u for u, _, _ in HILL], v=[v for _, v, _ in HILL])
    table["flags"] = ["slewed", "saturated", "controlled saturated"] + [""] * 6
    table.assign(telemetry_samples=900).to_csv(folder / "trials.csv", index=False)
    code, stdout, err = run(capsys, monkeypatch, "report", folder, "--out", out, "--no-compare", "--json")
    assert code == 0, err
    page = " ".join((out / "report.html").read_text().split())
    assert "P1 is the only participant" in page and "1 participant gave 8 responses" in page
    assert "recorded for 9 trials (saturated 2, slewed 1, controlled 1); excluded by [study] exclude_flags" in page
    counts = {"recorded": 9, "flagged": {"saturated": 2, "slewed": 1, "controlled": 1}, "left_out": 1}
    content = json.loads(stdout)["materials"][""]
    assert content["flags"] == counts and [p["participant"] for p in content["participants"]] == ["P1"]


@pytest.mark.deep
def test_a_report_of_two_materials(capsys, monkeypatch, tmp_path):
    table = pd.read_csv("hilbo/data/video_quality.csv", dtype=str)
    table = table[table["participant"].isin(["V01", "V02", "V03", "V04"])].groupby("participant").head(15)
    table["material"] = np.where(table["participant"].isin(["V01", "V02"]), "one", "two")
    folder, out = tmp_path / "folder", tmp_path / "out"
    folder.mkdir()
    text = Path("hilbo/data/video_quality.toml").read_text()
    (folder / "study.toml").write_text(f"{text}\n[report]\nhypotheses = true\n")
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
            "alternatives.csv",
            "inference.nc",
            "map.nc",
        ):
            assert (out / name / file).stat().st_size
        assert all((out / name / f"classes.{kind}").stat().st_size for kind in ("png", "svg"))
        assert "passivity" not in (out / name / "dictionary.csv").read_text()  # nothing of a renderer
        check_reserved(out / name, folder / "study.toml")
    page = " ".join((out / "report.html").read_text().split())
    assert page.count("data:image/png;base64,") == 2 * 10 + 1 and "http://" not in page
    assert "Hypothesis 4" in page and "fair, good, excellent" in page
    assert run(capsys, monkeypatch, "report", folder, "--out", out, "--force", "--exclude", "mood > 1")[0] == 2


def check_reserved(folder, path):
    """No parameter of a study may be called as a column of a table that has one for each parameter."""
    study = Study.load(path)
    heads = {file.name: list(pd.read_csv(file, nrows=0)) for file in folder.glob("*.csv")}
    with_all = {name: head for name, head in heads.items() if {*study.space.names} <= {*head}}
    assert {"optima.csv", "alternatives.csv"} <= set(with_all)
    for head in with_all.values():
        assert all(is_reserved(name, study.responses, False) for name in head if name not in study.space.names)


def test_the_comparison_of_rules_is_shown():
    """From the content of `rule_comparison.compare`: a row for each rule, refused ones too, and two figures."""
    scores = {
        "negative_log_density": 1.1,
        "negative_log_density_error": 0.1,
        "difference": 0.0,
        "difference_error": 0.0,
        "central_95": 0.94,
        "central_95_error": 0.01,
    }
    bins = [{"predicted": 0.1, "observed": 0.2}, {"predicted": 0.8, "observed": 0.7}]
    best = scores | {
        "method": "by points",
        "z2": 1.2,
        "covered": 0.5,
        "optimum_sd": 0.2,
        "optimum": {"u": 0.4, "v": 12.0},
    }
    best |= {"influence": {"A": 0.1, "B": 0.3}, "reliability": bins}
    worse = best | {"negative_log_density": 1.3, "difference": 0.2, "difference_error": 0.05}
    content = {
        "rules": {"bcm": worse, "hierarchical": best, "pooled": {"refused": "too many"}},
        "recommendation": "Use hierarchical.",
    }
    shown = comparison_section(plain(), content)
    assert shown["words"] == "Use hierarchical."
    assert shown["head"][:3] == ["method", "negative log density", "difference"]
    assert [row[:3] for row in shown["rows"]] == [["hierarchical", "1.100", ""], ["bcm", "1.300", "+0.200 ± 0.050"]]
    assert shown["refused"] == ["pooled: too many"]
    figures = comparison_figures(content)
    assert set(figures) == {"comparison", "reliability"} and len(figures["comparison"].axes) == 2


def test_no_column_of_what_is_not_there():
    rows = {"optimum": ["population", "mid"], "u": [0.25, 1.0], "mean": [0.123, np.nan]}
    rows |= {"passivity_margin": [None, None]}
    shown = alternatives_rows(plain(), pd.DataFrame(rows))
    assert shown["head"] == ["", "u", "latent score"]
    assert shown["rows"] == [["population map (bcm)", "0.250", "0.12"], ["mid of the sets to compare", "1.000", ""]]


def test_every_estimate_of_the_optimum_has_words():
    labels = [
        "population",
        *(f"population, {name}" for name in ("ep", "laplace", *RULES, "optimised hyperparameters")),
    ]
    rows = alternatives_rows(plain(), pd.DataFrame({"optimum": labels, "u": 0.5}))["rows"]
    words = [row[0] for row in rows]
    assert len(set(words)) == len(words) and not any(label in words for label in labels[:-1])
