"""The figures of a study's report, with titles and captions: what is to be seen, and which of the paper's it is."""

from typing import Any

import numpy as np

from hilbo.analysis import Analysis
from hilbo.rule_words import in_place
from hilbo.study_folder import Material

__all__ = ["comparison_figures", "study_figures"]

Figures = dict[str, tuple[Any, str, str]]  # name -> figure, title, caption


def study_figures(found: Analysis, material: Material, shares: tuple[np.ndarray, np.ndarray]) -> Figures:
    """Figures 4, 5, 6a, 7 and 8, people, individual optima and the predictive check; `shares` of
    `inference_data.predictive_shares`."""
    from hilbo import plotting, plotting_study

    study, cohort, progress = found.study, found.cohort, found.progress
    best, top = np.asarray(found.aggregate.optimum.x), study.responses[-1]
    white = " White: not passive on the device, never rendered." if study.space.mechanics is not None else ""
    who, after = plotting_study.typical_person(found), _after(progress.counts)
    rows = np.searchsorted(progress.counts, after)
    how = in_place(found.aggregate.map)
    how = f" These maps are merged {how}." if how else ""
    references = {} if material.reference is None else {material.reference_name: material.reference}
    figures: Figures = {
        "progression": (
            plotting_study.posterior_progress(study, cohort, who, progress.own[rows, who], after),
            "One participant's map, trial by trial (paper, figure 4)",
            f"{cohort.names[who]}, whose optimum is at the median distance from the population's. Dots: what was asked,"
            f' orange where the answer was "{top}"; star: the highest point so far.{white}',
        ),
        "convergence": (
            plotting_study.individual_convergence(study, cohort, progress),
            "Convergence of the individuals (paper, figure 5)",
            "Left: each participant's running optimum against their final one. Right: how often they had answered"
            f' "{top}" by then. Lines are medians, bands hold the middle half of the people; on the left, of'
            " those who gave as many answers.",
        ),
        "map": (
            plotting_study.sets_on_map(
                study, found.aggregate.surface, found.sets, best, cohort, found.aggregate.map.map_prior
            ),
            "The population map and its best, mid and worst sets (paper, figure 6a)",
            f"Brighter: higher {study.attribute}. Hatched: hardly sampled, the map's sd there is above"
            f" {100 * plotting_study.UNKNOWN:.0f} % of what it is without answers. Dots: what was asked near the"
            f" slice, and may lie in its white.{white}",
        ),
        "maps-after": (
            plotting.slices_after(study, cohort, progress.merged[rows], after, found.aggregate.map),
            "The population map after fewer trials (paper, figure 7a)",
            f"From everybody's first answers only, each through its own optimum, the star.{white}{how}",
        ),
        "population-convergence": (
            plotting_study.population_convergence(progress, references),
            "Convergence of the population optimum (paper, figure 7b)",
            "How far the optimum of the map from everybody's first trials is from the optimum of the whole map"
            + (f", and from {material.reference_name}." if references else ".")
            + how,
        ),
        "classes": (
            plotting_study.class_regions(
                {"fixed hyperparameters": found.fixed, "optimised hyperparameters": found.optimised}
            ),
            "Where each answer is the likeliest (paper, figure 8)",
            f"The most probable answer on slices through each optimum (star). Lines: how far a parameter may move"
            f' while "{top}" stays the likeliest answer, on the nearest slice that may be rendered; the paper\'s figure'
            f" uses optimised hyperparameters.{white}",
        ),
        "people": (
            plotting_study.people_figure(found.people, found.left_out),
            "How people answered",
            "With 95 % intervals: how often a participant gave the same answer to the same rendering; how much of the"
            " answers that person's own map cannot tell from chance; and whether the criterion moved during the"
            " session (negative: stricter). Crosses: left out by the study's rule.",
        ),
        "predictive": (
            plotting_study.predictive_check(study.responses, *shares),
            "Posterior predictive check",
            "Bars: shares of the answers given. Dots: shares of answers that everybody's own posterior would give again"
            " at the same renderings, with 95 % of the draws.",
        ),
    }
    if study.space.dim > 1:
        marks = {"population map": best, "mean of optima": np.asarray(found.aggregate.mean_of_optima)} | references
        figures["optima"] = (
            plotting.optima_scatter(study, np.asarray(found.aggregate.individuals.x), marks),
            "Individual optima",
            "Each dot is one participant's own optimum.",
        )
    return figures


def comparison_figures(content: dict[str, Any]) -> Figures:
    """Every rule with each person left out, and the reliability of two of them; `content` of `comparison.compare`."""
    from hilbo import plotting_population as plotting

    return {
        "comparison": (
            plotting.rules_figure(content),
            "How every rule foretells people left out",
            "Left: mean negative log density of their answers, lower is better. Right: share of their answers within"
            " the central 95 % of what was foretold; the line is a calibrated map. Bars: standard errors by person.",
        ),
        "reliability": (
            plotting.reliability_figure(content),
            "Reliability of the class probabilities",
            "How often answers came that were foretold with a probability; on the line, as often as foretold.",
        ),
    }


def _after(counts):
    """Up to four of the numbers of trials: 5, 15 and 25 as in the paper, and the last."""
    chosen = [n for n in (5, 15, 25) if n in counts]
    return [*chosen, *([int(counts[-1])] if counts[-1] not in chosen else [])]
