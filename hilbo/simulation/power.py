"""How many participants and trials a study needs for a given error: from simulated studies whose truth is known.

Studies are simulated once, at the largest numbers asked for, M people and n trials each. Of a study's people the first
m are a study of m people, since people are drawn independently; of each participant the first t trials are those of a
session of t trials would have asked and heard, since a session looks back only. Criteria drift by the trial (the
population's drift over the study's own number of trials), so that a short session drifts less.

For every (m, t) a study is aggregated by the study's rule, and two errors are taken:
  optimum: NRMSE of the population optimum to the truth, in units of the search ranges;
  map: root mean square, over feasible points, of the difference between the probability of the goal that the
       map predicts for a new person and the one that the simulated population has (the mean over many people, in
       closed form).
Studies are dealt to processes, one core each; the numbers do not depend on how many there are.
"""

import contextlib
import json
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from multiprocessing.queues import SimpleQueue

import equinox as eqx
import jax
import numpy as np
import pandas as pd
from jaxtyping import Array, Float
from scipy.special import ndtr
from scipy.stats import binomtest

from hilbo.errors import InputError
from hilbo.likelihoods import Goal
from hilbo.numerics.tracing import program
from hilbo.population.maps import LARGEST_EXACT, RuleMap, learnt_map, rule_map
from hilbo.population.rules.registry import RULES
from hilbo.search.apart import differences
from hilbo.search.candidates import search_points
from hilbo.simulation.presets import with_truth
from hilbo.simulation.simulate import Person, Population, people, simulate_study
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import fit_cohort
from hilbo.study.estimate.learnt import by_rule, resolved
from hilbo.study.estimate.optimum import map_optimum

__all__ = ["Plan", "cores", "goal_probability", "one_study", "power_table", "simulate_power", "summarise"]

_POINTS = 256  # at which maps are compared
_CROWD = 2000  # people whose mean is the population's truth
_counted: list[SimpleQueue] = []  # in a process of the pool
_ONE_CORE = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"


class Plan(eqx.Module):
    """Numbers of participants and trials to evaluate, and the number of simulated studies."""

    participants: tuple[int, ...] = eqx.field(static=True)
    trials: tuple[int, ...] = eqx.field(static=True)
    studies: int = eqx.field(static=True)
    seed: int = eqx.field(static=True)

    def __check_init__(self):
        """Raise `InputError` for numbers that are repeated or below 1, and for fewer than two studies."""
        for name in ("participants", "trials"):
            values = getattr(self, name)
            if not values or min(values) < 1 or len(set(values)) < len(values):
                raise InputError(f"power: {name} is {list(values)}; give different whole numbers from 1.")
        if self.studies < 2:
            raise InputError(f"power: {self.studies} studies have no spread; simulate two at least.")


def simulate_power(
    study: Study,
    population_: Population,
    plan: Plan,
    *,
    jobs: int | None = None,
    begin: Callable[[], None] | None = None,
    say: Callable[[int, int], None] = lambda done, designs: None,
) -> pd.DataFrame:
    """Errors of every study at every (m, t): columns `study`, `participants`, `trials`, `optimum`, `map`.

    After an interruption (`KeyboardInterrupt`) the errors of the finished studies, if there are two.

    `jobs`: number of processes, by default that of the cores. All are new processes, even a single one, so that a
    script must guard its main part with `if __name__ == "__main__":`. Each calls `begin` first (float64, a cache), if
    given; otherwise it computes with JAX's defaults. `say` receives the number of (m, t) done in all studies, and of
    all. Raises `InputError` for a study without a single optimum (a goal between other responses and several
    parameters), and for numbers of participants or responses that the study's method cannot aggregate.
    """
    if not study.one_optimum:
        raise InputError(
            f'power: many stimuli are as good as the optimum, since the goal "{study.goal_label}" is between other'
            " answers and there are several parameters; plan with one parameter, or with a goal at an end of the scale."
        )
    _check_rule(study.rule, plan)
    jobs = min(cores() if jobs is None else jobs, plan.studies)
    sent = study.file.content, study.rule, population_, plan
    blocks: dict[int, pd.DataFrame] = {}
    designs = plan.studies * len(plan.participants) * len(plan.trials)
    with _pool(jobs, begin) as (pool, counted):  # of one process too: several cores add up in another order
        counting = threading.Thread(target=_count, args=(counted, designs, say), daemon=True)
        counting.start()
        work = {pool.submit(_study_in_process, *sent, i): i for i in range(plan.studies)}
        try:
            for done in as_completed(work):
                blocks[work[done]] = done.result()
        except KeyboardInterrupt:
            for process in multiprocessing.active_children():
                process.terminate()
            if len(blocks) < 2:
                raise
        else:
            counted.put(False)
            counting.join()
    return pd.concat([blocks[index] for index in sorted(blocks)], ignore_index=True)


def _count(counted: SimpleQueue, designs: int, say: Callable[[int, int], None]) -> None:
    """Call `say` with the number of designs done, of all `designs`, for each True in the queue, until False comes."""
    done = 0
    while counted.get():
        done += 1
        say(done, designs)


def _check_rule(rule: str, plan: Plan) -> None:
    """Raise InputError for numbers of participants or responses that the rule cannot aggregate."""
    if min(plan.participants) < RULES[rule].least_people:
        raise InputError(
            f'power: the rule "{rule}" estimates individual differences and needs two participants; give 2'
            " participants or more, or use another rule."
        )
    answers = max(plan.participants) * max(plan.trials)
    if RULES[rule].exact_only and answers > LARGEST_EXACT:
        raise InputError(
            f'power: the rule "{rule}" fits one model to all answers, at most {LARGEST_EXACT:,}, and'
            f" {max(plan.participants)} participants with {max(plan.trials)} trials give {answers:,}; ask for fewer, or"
            " use another rule."
        )


def cores() -> int:
    """Number of CPU cores available to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextlib.contextmanager
def _pool(jobs: int, begin: Callable[[], None] | None) -> Iterator[tuple[ProcessPoolExecutor, SimpleQueue]]:
    """Context manager with a pool of `jobs` new processes of one core each, which call `begin` first, and a queue to
    which they put True for each design that is done. Sets XLA_FLAGS in this process's environment, which they inherit,
    and restores it at the end."""
    before, context = os.environ.get("XLA_FLAGS"), get_context("spawn")
    os.environ["XLA_FLAGS"] = f"{before or ''} {_ONE_CORE}".strip()
    counted = context.SimpleQueue()
    try:
        with ProcessPoolExecutor(jobs, context, initializer=_begin, initargs=(begin, counted)) as pool:
            yield pool, counted
    finally:
        if before is None:
            del os.environ["XLA_FLAGS"]
        else:
            os.environ["XLA_FLAGS"] = before


def _begin(begin: Callable[[], None] | None, counted: SimpleQueue) -> None:
    """Begin a process of the pool, and keep the queue for `_study_in_process`."""
    _counted.append(counted)
    if begin is not None:
        begin()


def _study_in_process(content: str, rule: str, population_: Population, plan: Plan, index: int) -> pd.DataFrame:
    """Simulate study number `index` of the plan and return its errors, from arguments that can be sent to another
    process. `content`: the study file as JSON; `rule`: aggregation method."""
    study = by_rule(Study.from_dict({"schema": 1} | json.loads(content)), rule)
    return one_study(study, population_, plan, index, lambda: _counted[0].put(True))


def one_study(
    study: Study, population_: Population, plan: Plan, index: int, done: Callable[[], None] = lambda: None
) -> pd.DataFrame:
    """Simulate study number `index` of the plan; returns its errors at every (m, t), in the columns of
    `simulate_power`. `done` is called after each (m, t)."""
    most, longest = max(plan.participants), max(plan.trials)
    seed = int(np.random.default_rng([plan.seed, index]).integers(2**31))
    staged = _with_trials(study, longest)
    # A drift over the study's session, specified per trial, is this much over the longest one.
    scale = longest / study.file.selection.trials
    population_ = with_truth(study, population_, seed)
    persons = people(staged, population_, most, seed)
    persons = eqx.tree_at(lambda p: p.drift, persons, persons.drift * scale)
    trials = simulate_study(staged, persons, seed)
    cohort = Cohort(trials, np.zeros((most, longest, study.space.dim)), tuple(map(str, range(most))))
    candidates = search_points(study.space, 0)
    points = candidates[:_POINTS]
    truth = np.asarray(study.space.to_unit(np.array([population_.truth[name] for name in study.space.names])))
    target = goal_probability(people(study, population_, _CROWD, 0), study.goal, np.asarray(points))
    rows = {}
    for count in _turned(plan.trials, index):
        so_far = cohort.first(count)
        posteriors = None if RULES[study.rule].learns else fit_cohort(staged, so_far)
        for m in _turned(plan.participants, index):
            some, given = jax.tree.map(lambda leaf, m=m: leaf[:m], (posteriors, so_far.trials))
            judged = resolved(study, so_far.rows(np.arange(m)))
            if judged.learnt is None:
                map_ = rule_map(study.gp, given, study.rule, posteriors=some, inference=study.inference)
            else:
                map_ = learnt_map(judged.learnt, given)
            x = np.asarray(map_optimum(judged, map_, candidates).x)
            probabilities = np.asarray(_map_goal_probability(judged, map_, points))
            rows[m, count] = _rms(differences(persons.levels, x, truth)), _rms(probabilities - target)
            done()
    cells = [(index, m, count, *rows[m, count]) for count in plan.trials for m in plan.participants]
    return pd.DataFrame(cells, columns=["study", "participants", "trials", "optimum", "map"])


def _turned(numbers: tuple[int, ...], index: int) -> tuple[int, ...]:
    """Numbers in reverse order for every second study, so that two processes share the compilation of the programs."""
    return numbers[:: -1 if index % 2 else 1]


def _rms(difference: Float[np.ndarray, "..."]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(difference**2)))


@program
def _map_goal_probability(study: Study, map_: RuleMap, points: Float[Array, "m d"]) -> Float[Array, " m"]:
    """Predicted probability of the goal as a new participant's response at each point. (m,)."""
    return map_.class_probabilities(study.gp.likelihood, points)[:, study.goal.category]


def _with_trials(study: Study, trials: int) -> Study:
    """Copy of the study with another number of trials; the space-filling ones are reduced to it if they are more."""
    content = json.loads(study.file.content)
    content.setdefault("selection", {})["trials"] = trials
    filling = min(study.file.selection.space_filling, trials)
    content["selection"]["space_filling"] = filling
    return by_rule(Study.from_dict({"schema": 1} | content), study.rule)


def goal_probability(persons: Person, goal: Goal, x: Float[np.ndarray, "m d"]) -> Float[np.ndarray, " m"]:
    """Probability (m,) of the goal as the response in the middle of a session, averaged over the simulated persons.

    With the criteria around the goal, of which the upper one is infinite for the lowest response and the lower one for
    the highest, P = (1 - lapse) (Phi(upper) - Phi(lower)) + lapse / C, each in units of the noise from s + drift / 2.
    """
    each = jax.tree.map(lambda leaf: np.asarray(leaf), persons)
    infinite = np.full((len(each.noise), 1), np.inf)
    edges = np.concatenate([infinite, each.criteria, -infinite], axis=1)[:, [goal.category, goal.category + 1]]
    steady = each.perceived(x[:, None, :]) + each.direction * each.drift / 2
    upper, lower = (ndtr((edge - steady) / each.noise) for edge in edges.T)
    return np.mean((1 - each.lapse) * (upper - lower) + each.lapse / goal.categories, axis=1)


def summarise(errors: pd.DataFrame, error: float) -> pd.DataFrame:
    """Summary for every (m, t): median and quartiles of both errors, and proportion of studies that reach the target.

    The target is an error of the optimum of at most `error`. Columns end in `_median`, `_low`, `_high`; `reached` with
    its 95 % Wilson interval; `reached_surely` is its exact (Clopper-Pearson) lower 95 % confidence bound, one-sided.
    """
    groups = errors.groupby(["participants", "trials"])
    table = pd.DataFrame({
        f"{name}_{word}": groups[name].quantile(q)
        for name in ("optimum", "map")
        for word, q in (("median", 0.5), ("low", 0.25), ("high", 0.75))
    })  # fmt: skip
    within, count = groups["optimum"].apply(lambda values: int((values <= error).sum())), groups.size()
    table["reached"] = within / count
    ends = [binomtest(k, n).proportion_ci(method="wilson") for k, n in zip(within, count, strict=True)]
    table["reached_low"], table["reached_high"] = [e.low for e in ends], [e.high for e in ends]
    exact = [binomtest(k, n, alternative="greater").proportion_ci(0.95) for k, n in zip(within, count, strict=True)]
    table["reached_surely"] = [e.low for e in exact]
    table["studies"] = count
    return table.reset_index()


def power_table(summary: pd.DataFrame, value: str) -> pd.DataFrame:
    """One column of the summary (`value`) as a table: a row per number of participants, a column per number of
    trials."""
    return summary.pivot(index="participants", columns="trials", values=value)
