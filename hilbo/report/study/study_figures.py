"""Figures of a study's report by name; their titles and captions are in the page's template."""

from typing import Any

import numpy as np

from hilbo.study.analysis.analysis import Analysis
from hilbo.study.analysis.effects import effects_of
from hilbo.study.folder import Material
from hilbo.study.results.map_netcdf import on_grid

__all__ = ["comparison_figures", "study_figures"]

Figures = dict[str, Any]  # name -> figure


def study_figures(
    analysis: Analysis, material: Material, shares: tuple[np.ndarray, np.ndarray]
) -> tuple[Figures, bool]:
    """Matplotlib figures of one material by name (4, 5, 6a, 7 and 8 of the paper, participants, individual optima,
    predictive check); and whether a part of the map is hatched as hardly sampled.

    `shares`: observed and predicted response proportions, of `arviz_groups.predictive_shares`. "effects" is only for
    spaces without a grid, "optima" not for one parameter.
    """
    from hilbo.report.figures import maps, people, study
    from hilbo.report.figures import progress as progress_figures
    from hilbo.report.figures.effects import effects_figure
    from hilbo.report.figures.goal_map import goal_map
    from hilbo.report.figures.regions import class_regions

    chosen, cohort, aggregate, progress = analysis.study, analysis.cohort, analysis.aggregate, analysis.progress
    best, prior = np.asarray(aggregate.optimum.x), aggregate.map.map_prior
    references = {} if material.reference is None else {material.reference.name: material.reference.x}
    regions = {
        f"hyperparameters: {label}": reading
        for label, reading in zip(analysis.hyperparameters.labels, (analysis.fixed, analysis.optimised), strict=True)
    }
    map_, hatched = study.sets_on_map(chosen, aggregate.surface, analysis.sets, best, cohort, prior)
    figures = {
        "goal-map": goal_map(chosen, aggregate, analysis.population.region),
        "progression": study.posterior_progress(chosen, cohort, progress, study.typical_person(analysis)),
        "convergence": progress_figures.individual_convergence(chosen, cohort, progress),
        "map": map_,
        "maps-after": maps.slices_after(chosen, progress),
        "population-convergence": progress_figures.population_convergence(progress, references),
        "classes": class_regions(regions),
        "people": people.people_figure(analysis.people, analysis.left_out),
        "predictive": people.predictive_check(chosen.responses, *shares),
    }
    if not on_grid(chosen.space):
        effects = effects_of(chosen, aggregate.surface, best, analysis.population.seed)
        figures["effects"] = effects_figure(chosen, effects, best)
    if chosen.space.dim > 1:  # a scatter of one parameter is none
        marks = {"population map": best, "mean of optima": np.asarray(aggregate.mean_of_optima)} | references
        figures["optima"] = maps.optima_scatter(chosen, np.asarray(aggregate.individuals.x), marks)
    return figures, hatched


def comparison_figures(content: dict[str, Any]) -> Figures:
    """Matplotlib figures of a comparison of aggregation methods: "comparison" and "reliability". `content`: of
    `rule_comparison.compare`.
    """
    from hilbo.report.figures import population

    return {"comparison": population.rules_figure(content), "reliability": population.reliability_figure(content)}
