"""Simulated studies for planning: truths in closed form, prefixes that are studies of their own, and bad plans."""

import contextlib
import dataclasses
import json
import multiprocessing
import sys
from concurrent.futures import Future

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy.stats import binom

from hilbo import Study
from hilbo.cli import main
from hilbo.cli.terminal.console import start
from hilbo.errors import InputError
from hilbo.likelihoods import Goal
from hilbo.report.figures.power import power_figure
from hilbo.report.power import _hours, enough, write_power
from hilbo.simulation import power
from hilbo.simulation.power import (
    Plan,
    _with_trials,
    goal_probability,
    power_table,
    simulate_power,
    summarise,
)
from hilbo.simulation.presets import PRESETS
from hilbo.simulation.simulate import people
from hilbo.study.estimate.learnt import by_rule


def study():
    return Study.load("hilbo/data/paper.toml")


def test_the_probability_of_the_highest_answer_is_that_of_many_answers():
    persons = people(study(), PRESETS["paper"], 3, 5)
    x = np.array([[0.15, 0.2, 0.2], [0.6, 0.6, 0.4]])
    keys, half = jax.random.split(jax.random.key(0), 20_000), jnp.asarray(0.5)

    @jax.jit
    def share(point):
        given = jax.vmap(lambda person: jax.vmap(lambda key: person.answer(key, point, half))(keys))(persons)
        return jnp.mean(given == 2)

    shares = [float(share(jnp.asarray(point))) for point in x]
    np.testing.assert_allclose(goal_probability(persons, Goal.highest(3), x), shares, atol=0.01)


def test_summaries_of_errors_that_are_known():
    rows = [(s, m, t, 0.1 * s / m, 0.01 * t) for s in range(5) for m in (1, 2) for t in (10, 20)]
    errors = pd.DataFrame(rows, columns=["study", "participants", "trials", "optimum", "map"])
    table = summarise(errors, 0.2)
    assert power_table(table, "optimum_median").loc[1, 10] == pytest.approx(0.2)
    assert power_table(table, "reached").to_numpy().tolist() == [[0.6, 0.6], [1.0, 1.0]]
    assert power_table(table, "map_median").loc[2, 20] == pytest.approx(0.2)
    assert enough(table, 0.5)["trials"].tolist()[1] == 10 and np.isnan(enough(table, 0.5)["trials"][0])
    assert enough(table)["trials"].isna().all()  # 5 of 5 are no proof of 80 %
    n, z = 5, 1.959963984540054  # all five within: Wilson's interval ends at 1 / (1 + z^2 / n)
    np.testing.assert_allclose(table[["reached_low", "reached_high"]].iloc[2], [1 / (1 + z**2 / n), 1.0])
    assert len(power_figure(table, 0.2).axes) == 3


def test_the_page_says_how_sure_a_share_is(tmp_path):
    rows = [(s, 2, t, 0.1 * s, 0.01 * t) for s in range(5) for t in (10, 20)]
    errors = pd.DataFrame(rows, columns=["study", "participants", "trials", "optimum", "map"])
    cost = {"preset": "paper", "material": "gel", "seconds": 1.0, "jobs": 1}
    content = write_power(study(), errors, Plan((2,), (10, 20), 5, 0), 0.25, cost, tmp_path)
    page = " ".join((tmp_path / "report.html").read_text().split())
    assert "60 % (23 to 88)" in page and "population “paper”, material gel, were simulated" in page
    assert content["summary"][0]["reached_low"] == pytest.approx(0.2307, abs=1e-4)
    assert "2 participants: not shown by these 5 studies, up to 20 trials" in " ".join(
        (tmp_path / "report.html").read_text().split()
    )


def test_enough_is_what_larger_numbers_hold_too():
    reached = {2: [0.9, 0.7, 0.8, 0.85], 3: [0.7, 0.9, 0.9, 0.79], 4: [0.8, 0.8, 0.8, 0.8]}
    rows = [(m, 10 + 5 * i, share) for m, shares in reached.items() for i, share in enumerate(shares)]
    needed = enough(pd.DataFrame(rows, columns=["participants", "trials", "reached_surely"]))
    np.testing.assert_array_equal(needed["trials"], [20, np.nan, 10])


def test_a_design_that_is_too_short_is_seldom_called_enough():
    """40 studies each of four designs, of which the first two are within the error too seldom."""
    shares, studies, runs = [0.70, 0.75, 0.80, 0.90], 40, 400
    # What is said of a design in which k of the 40 studies are within the error, for every k.
    within, study = np.divmod(np.arange((studies + 1) * studies), studies)
    errors = pd.DataFrame({"study": study, "participants": within, "trials": 1, "optimum": study >= within, "map": 0.0})
    said = summarise(errors.astype({"optimum": float}), 0.5)
    drawn = np.random.default_rng(3).binomial(studies, shares, (runs, 4)).ravel()
    designs = {"participants": np.repeat(np.arange(runs), 4), "trials": np.tile([10, 15, 20, 25], runs)}
    summary = said.iloc[drawn].reset_index(drop=True).assign(**designs)
    assert (enough(summary)["trials"] < 20).mean() < 0.05
    assert (enough(summary.assign(reached_surely=summary["reached"]))["trials"] < 20).mean() > 0.2


def test_the_surest_share_is_the_exact_bound():
    errors = pd.DataFrame(
        {"study": range(40), "participants": 2, "trials": 5, "map": 0.0, "optimum": [0.0] * 37 + [1.0] * 3}
    )
    k, n = 37, 40
    bound = summarise(errors, 0.5)["reached_surely"][0]
    assert binom.sf(k - 1, n, bound) == pytest.approx(0.05, abs=1e-12)  # so many, or more, one time in twenty
    all_of_them = summarise(errors.assign(optimum=0.0), 0.5)["reached_surely"][0]
    assert all_of_them == pytest.approx(0.05 ** (1 / 40), rel=1e-12)
    assert summarise(errors.assign(optimum=1.0), 0.5)["reached_surely"][0] == 0.0


def test_hours_are_those_of_all_steps():
    """The paper's: 12 renderings of warm-up and 25 trials of 8 s."""
    paper = Study.load("hilbo/data/paper.toml")
    assert _hours(paper, participants=24.0, trials=25.0) == pytest.approx(24 * 37 * 8 / 3600)
    assert _hours(paper, participants=24.0, trials=float("nan")) is None


@pytest.mark.parametrize("rule", ["average", "learnt-2"])
def test_a_rule_in_place_of_the_files_stays_with_other_numbers_of_trials(rule):
    shorter = _with_trials(by_rule(study(), rule), 7)
    assert (shorter.rule, shorter.file.selection.trials) == (rule, 7)


def test_one_person_cannot_differ():
    with pytest.raises(InputError, match="give 2 participants or more"):
        simulate_power(dataclasses.replace(study(), rule="hierarchical"), PRESETS["paper"], Plan((1, 3), (5,), 2, 0))


def test_more_answers_than_one_model_takes_are_refused_before_anything_is_simulated():
    with pytest.raises(InputError, match="at most 1,500, and 61 participants with 25 trials give 1,525"):
        simulate_power(dataclasses.replace(study(), rule="pooled"), PRESETS["paper"], Plan((2, 61), (5, 25), 2, 0))


@pytest.mark.parametrize("plan", [((), (5,), 4), ((3, 3), (5,), 4), ((0,), (5,), 4), ((3,), (5,), 1)])
def test_plans_that_say_nothing_are_refused(plan):
    with pytest.raises(InputError, match="power: "):
        Plan(*plan, seed=0)


@pytest.mark.parametrize(
    ("option", "words"),
    [
        (("--participants", "six"), "write whole numbers separated by commas"),
        (("--preset", "nobody"), '--preset is "nobody"'),
        (("--trials", "5,5"), "give different whole numbers"),
    ],
)
def test_bad_options_write_nothing(capsys, monkeypatch, tmp_path, option, words):
    monkeypatch.setattr(
        sys, "argv", ["hilbo", "power", "hilbo/data/paper.toml", "--out", str(tmp_path / "out"), *option]
    )
    with pytest.raises(SystemExit) as stopped:
        main.main()
    assert stopped.value.code == 2 and words in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.deep
def test_the_command_says_what_it_cost(capsys, monkeypatch, tmp_path):
    out = tmp_path / "out"
    few = ["--participants", "2,3", "--trials", "6", "--studies", "2", "--jobs", "2", "--json"]
    monkeypatch.setattr(sys, "argv", ["hilbo", "power", "hilbo/data/paper.toml", "--out", str(out), *few])
    with pytest.raises(SystemExit) as stopped:
        main.main()
    content = json.loads(capsys.readouterr().out)
    assert not stopped.value.code and content["jobs"] == 2 and content["seconds"] > 0 and content["seed"] == 0
    assert len(pd.read_csv(out / "errors.csv")) == 4 and len(content["summary"]) == 2
    page = " ".join((out / "report.html").read_text().split())
    assert "on 2 cores" in page and page.count("data:image/png;base64,") == 1


def test_the_studies_that_were_finished_before_an_interruption_are_returned(monkeypatch):
    def finished(after):
        def interrupted(work):
            yield from list(work)[:after]
            raise KeyboardInterrupt

        return interrupted

    def a_study(*sent):
        future = Future()
        future.set_result(pd.DataFrame({"study": [sent[-1]], "optimum": 0.1}))
        return future

    class Pool:
        def submit(self, _function, *sent):
            return a_study(*sent)

    queue = multiprocessing.get_context("spawn").SimpleQueue()
    queue.put(False), queue.put(False)
    monkeypatch.setattr(power, "_pool", lambda jobs, begin: contextlib.nullcontext((Pool(), queue)))
    monkeypatch.setattr(power.multiprocessing, "active_children", list)
    plan = Plan((2, 3), (6,), 5, 0)
    monkeypatch.setattr(power, "as_completed", finished(3))
    assert simulate_power(study(), PRESETS["paper"], plan, jobs=1)["study"].tolist() == [0, 1, 2]
    monkeypatch.setattr(power, "as_completed", finished(1))
    with pytest.raises(KeyboardInterrupt):
        simulate_power(study(), PRESETS["paper"], plan, jobs=1)


@pytest.mark.deep
def test_designs_are_counted_while_they_are_simulated():
    counts = []
    plan = Plan((2, 3), (6,), 2, 1)
    simulate_power(study(), PRESETS["paper"], plan, jobs=2, begin=start, say=lambda *each: counts.append(each))
    assert counts == [(done, 4) for done in (1, 2, 3, 4)]


@pytest.mark.deep
def test_errors_do_not_depend_on_the_number_of_processes():
    plan = Plan((2, 3), (6, 8), 2, 1)
    one, two = (simulate_power(study(), PRESETS["paper"], plan, jobs=jobs, begin=start) for jobs in (1, 2))
    pd.testing.assert_frame_equal(one, two, check_exact=True)
    assert one["study"].tolist() == [0] * 4 + [1] * 4 and one[["optimum", "map"]].gt(0).all(axis=None)
    assert not np.allclose(one["optimum"][:4], one["optimum"][4:])
