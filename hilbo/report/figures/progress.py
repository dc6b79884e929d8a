"""Figures of convergence: the population's optimum and the individual ones over the trials."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from hilbo.report.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ONE_COLUMN,
    RED,
    TWO_COLUMNS,
    band,
    few_ticks,
    legend,
    new_figure,
    plain,
    styled,
)
from hilbo.search.apart import nrmse
from hilbo.study.analysis.cohort_results import CohortResults
from hilbo.study.analysis.progress import Progress
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study

__all__ = ["individual_convergence", "population_convergence", "progress_figure"]


@styled
def individual_convergence(study: Study, cohort: Cohort, progress: Progress) -> Figure:
    """Left: NRMSE of individual optima after each number of trials to their final ones, and to the optimum of half of
    the other participants. Right: cumulative responses that are the goal.

    Median and quartiles over participants. Paper, figure 5.
    """
    trials, (_, errors) = progress.counts, progress.to_end()
    figure, (left, right) = new_figure(TWO_COLUMNS, 2.6, 1, 2)
    band(left, trials, 100 * errors.T, BLUE, "to their own final optimum")
    if progress.splits:
        others = 100 * np.nanmedian(np.where(np.isnan(errors), np.nan, progress.individual_to_half), axis=1)
        left.plot(trials, others, color=GREY, linestyle="--", label="to that of half of the others")
    left.set(xlabel="trials", ylabel="NRMSE of individual optima (%)", ylim=(0, None))
    left.legend(frameon=False)
    _top_answers(right, study, cohort, trials, "trials")
    few_ticks(left.xaxis, 6, integer=True)
    return figure


def _top_answers(axes, study: Study, cohort: Cohort, trials: np.ndarray, xlabel: str) -> None:
    """Draw the cumulative number of responses that are the goal on `axes`: median and quartiles over
    participants. `trials`: numbers of trials.
    """
    top = np.asarray((cohort.trials.q == study.goal.category) & cohort.trials.mask)
    band(axes, trials, np.cumsum(top, axis=1)[:, trials - 1], GREEN, "median, quartiles")
    axes.set(xlabel=xlabel, ylabel=f'cumulative "{plain(study.goal_label)}" responses', ylim=(0, None))
    axes.legend(frameon=False, loc="upper left")
    few_ticks(axes.yaxis, 5, integer=True)
    few_ticks(axes.xaxis, 6, integer=True)


@styled
def population_convergence(progress: Progress, references: Mapping[str, Float[np.ndarray, " d"]]) -> Figure:
    """NRMSE of the population's optimum after each number of trials to its final one, and to named `references` (d,) in
    the unit cube, such as system identification or the truth, at most two; dashed: between the optima of random halves
    of the participants. Paper, figure 7b.
    """
    looks = [(RED, "o", "-"), (BLUE, "s", "--"), (GREEN, "^", "-.")]
    targets = {"its final optimum": progress.population[-1]} | dict(references)
    figure, axes = new_figure(ONE_COLUMN, 2.7)
    for (name, x), (colour, marker, dashes) in zip(targets.items(), looks, strict=False):
        miss = 100 * np.asarray(nrmse(progress.population, x, progress.levels))
        look = {"color": colour, "marker": marker, "linestyle": dashes, "markersize": 3.5}
        axes.plot(progress.counts, miss, label=f"to {name}", **look)
    if progress.splits:
        halves = 100 * np.median(progress.halves, axis=1)
        axes.plot(progress.counts, halves, color=GREY, linestyle="--", label="between split halves")
    axes.set(xlabel="trials of each participant", ylabel="NRMSE of the population optimum (%)", ylim=(0, None))
    few_ticks(axes.xaxis, 6, integer=True)
    legend(figure, axes.get_legend_handles_labels()[0])
    return figure


@styled
def progress_figure(study: Study, population: CohortResults, truth: Float[np.ndarray, " d"] | None = None) -> Figure:
    """Left: NRMSE of individual and population optima, after each number of trials, to the last ones or to the `truth`
    (d,) in the unit cube, if known. Right: cumulative responses in the top category.

    Waits for the progress to be computed. Raises `InputError` if it was not requested.
    """
    progress = population.progress
    trials = progress.counts
    to_end, individual_errors = progress.to_end()
    from_goal = to_end
    if truth is not None:
        from_goal = np.asarray(nrmse(progress.population, truth, progress.levels))
        individual_errors = np.asarray(nrmse(progress.individual, truth, progress.levels))
    figure, (left, right) = new_figure(TWO_COLUMNS, 2.7, 1, 2)
    goal = "the final optimum" if truth is None else "the truth"
    band(left, trials, 100 * individual_errors.T, BLUE, "individuals: median, quartiles")
    left.plot(trials, 100 * from_goal, color=RED, marker="o", markersize=3, label="population map")
    if truth is not None:
        left.plot(trials, 100 * to_end, color=GREY, linestyle="--", label="population map, to its final optimum")
    elif progress.splits:
        halves = 100 * np.median(progress.halves, axis=1)
        left.plot(trials, halves, color=GREY, linestyle="--", label="between split halves")
    left.set(xlabel="trials of each participant", ylabel=f"NRMSE to {goal} (%)")
    left.set_ylim(0, left.get_ylim()[1] * 1.25)  # room for the legend
    left.legend(frameon=False, loc="upper right")
    _top_answers(right, study, population.cohort, trials, "trials of each participant")
    few_ticks(left.xaxis, 6, integer=True)
    return figure
