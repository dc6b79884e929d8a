"""The figures of a study's report, with titles and captions: what is to be seen, and which of the paper's it is."""

from typing import Any

import numpy as np

from hilbo.study.analysis import Analysis
from hilbo.study.folder import Material
from hilbo.study.heterogeneity import in_place

__all__ = ["comparison_figures", "study_figures"]

Figures = dict[str, tuple[Any, str, str]]  # name -> figure, title, caption


def study_figures(found: Analysis, material: Material, shares: tuple[np.ndarray, np.ndarray]) -> Figures:
    """Figures 4, 5, 6a, 7 and 8, people, individual optima and the predictive check; `shares` of
    `inference_data.predictive_shares`."""
    references = {} if material.reference is None else {material.reference_name: material.reference}
    return (
        _individuals(found)
        | _population_map(found)
        | _population_convergence(found, references)
        | _classes(found)
        | _answers(found, shares)
        | _optima(found, references)
    )


def comparison_figures(content: dict[str, Any]) -> Figures:
    """Every rule with each person left out, and the reliability of two of them; `content`: of
    `study.rule_comparison`."""
    from hilbo.report.figures import population as plotting

    return {
        "comparison": (
            plotting.rules_figure(content),
            "How every rule predicts people left out",
            "Left: mean negative log density of their answers, lower is better. Right: share of their answers within"
            " the central 95 % of what was predicted; the line is a calibrated map. Bars: standard errors by person.",
        ),
        "reliability": (
            plotting.reliability_figure(content),
            "Reliability of the class probabilities",
            "How often answers came that were predicted with a probability; on the line, as often as predicted.",
        ),
    }


def _individuals(analysis: Analysis) -> Figures:
    """How single participants came to their optima."""
    from hilbo.report.figures import study as plotting_study

    study, cohort, progress, top = analysis.study, analysis.cohort, analysis.progress, analysis.study.responses[-1]
    who = plotting_study.typical_person(analysis)
    return {
        "progression": (
            plotting_study.posterior_progress(study, cohort, progress, who),
            "One participant's map, trial by trial (paper, figure 4)",
            f"{cohort.names[who]}, whose optimum is at the median distance from the population's. Dots: what was asked,"
            f' orange where the answer was "{top}"; star: the highest point so far.{_white(study)}',
        ),
        "convergence": (
            plotting_study.individual_convergence(study, cohort, progress),
            "Convergence of the individuals (paper, figure 5)",
            "Left: each participant's running optimum against their final one. Right: how often they had answered"
            f' "{top}" by then. Lines are medians, bands hold the middle half of the people; on the left, of'
            " those who gave as many answers.",
        ),
    }


def _population_map(analysis: Analysis) -> Figures:
    """The population's map from all answers, and from the first ones."""
    from hilbo.report.figures import maps
    from hilbo.report.figures import study as plotting_study

    study, cohort, aggregate = analysis.study, analysis.cohort, analysis.aggregate
    return {
        "map": (
            plotting_study.sets_on_map(
                study,
                aggregate.surface,
                analysis.sets,
                np.asarray(aggregate.optimum.x),
                cohort,
                aggregate.map.map_prior,
            ),
            "The population map and its best, mid and worst sets (paper, figure 6a)",
            f"Brighter: higher {study.attribute}. Hatched: hardly sampled, the map's sd there is above"
            f" {100 * plotting_study.UNKNOWN:.0f} % of what it is without answers. Dots: what was asked near the"
            f" slice, and may lie in its white.{_white(study)}",
        ),
        "maps-after": (
            maps.slices_after(study, analysis.progress),
            "The population map after fewer trials (paper, figure 7a)",
            f"From everybody's first answers only, each through its own optimum, the star.{_white(study)}"
            f"{_how(analysis)}",
        ),
    }


def _population_convergence(analysis: Analysis, references: dict[str, Any]) -> Figures:
    from hilbo.report.figures import study as plotting_study

    return {
        "population-convergence": (
            plotting_study.population_convergence(analysis.progress, references),
            "Convergence of the population optimum (paper, figure 7b)",
            "How far the optimum of the map from everybody's first trials is from the optimum of the whole map"
            + "".join(f", and from {name}" for name in references)
            + f".{_how(analysis)}",
        ),
    }


def _classes(analysis: Analysis) -> Figures:
    from hilbo.report.figures import study as plotting_study

    regions = {"fixed hyperparameters": analysis.fixed, "optimised hyperparameters": analysis.optimised}
    return {
        "classes": (
            plotting_study.class_regions(regions),
            "Where each answer is the likeliest (paper, figure 8)",
            "The most probable answer on slices through each optimum (star). Lines: how far a parameter may move while"
            f' "{analysis.study.responses[-1]}" stays the likeliest answer, on the nearest slice that may be rendered;'
            f" the paper's figure uses optimised hyperparameters.{_white(analysis.study)}",
        ),
    }


def _answers(analysis: Analysis, shares: tuple[np.ndarray, np.ndarray]) -> Figures:
    """How people used the answers, and whether the model would give the same ones."""
    from hilbo.report.figures import study as plotting_study

    return {
        "people": (
            plotting_study.people_figure(analysis.people, analysis.left_out),
            "How people answered",
            "With 95 % intervals: how often a participant gave the same answer to the same rendering; how much of the"
            " answers that person's own map cannot tell from chance; and whether the criterion moved during the"
            " session (negative: stricter). Crosses: left out by the study's rule.",
        ),
        "predictive": (
            plotting_study.predictive_check(analysis.study.responses, *shares),
            "Posterior predictive check",
            "Bars: shares of the answers given. Dots: shares of answers that everybody's own posterior would give again"
            " at the same renderings, with 95 % of the draws.",
        ),
    }


def _optima(analysis: Analysis, references: dict[str, Any]) -> Figures:
    """Of more than one parameter only: a scatter of one is none."""
    from hilbo.report.figures import maps

    if analysis.study.space.dim == 1:
        return {}
    aggregate = analysis.aggregate
    marks = {
        "population map": np.asarray(aggregate.optimum.x),
        "mean of optima": np.asarray(aggregate.mean_of_optima),
    } | references
    return {
        "optima": (
            maps.optima_scatter(analysis.study, np.asarray(aggregate.individuals.x), marks),
            "Individual optima",
            "Each dot is one participant's own optimum.",
        ),
    }


def _white(study) -> str:
    """What white means on a map, where anything is."""
    return " White: not passive on the device, never rendered." if study.space.mechanics is not None else ""


def _how(analysis: Analysis) -> str:
    """How maps were merged, where that needs saying."""
    how = in_place(analysis.aggregate.map)
    return f" These maps are merged {how}." if how else ""
