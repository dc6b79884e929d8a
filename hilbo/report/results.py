"""Results of an aggregation: result.json, a population map in netCDF, figures, and one self-contained HTML page.

`write_results` makes a whole results folder from an analysis: result.json (DESIGN: "Results"), optima.csv, map.nc, the
figures as PNG, SVG and PDF, and report.html with the figures inside.
"""

import base64
import importlib.metadata
import json
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Array, Float

from hilbo.report.figures.painter import write_figures
from hilbo.report.large_population import coarse_cells, figures_of_many
from hilbo.report.page import Pictures, results_page
from hilbo.report.participants import People, people_of
from hilbo.report.result_file import write_result
from hilbo.search.apart import differences, nrmse
from hilbo.search.rendering import K0_range, Rendering
from hilbo.study.analysis.cohort_results import CohortResults
from hilbo.study.analysis.effects import effects_of
from hilbo.study.analysis.heterogeneity import heterogeneity, how_aggregated, rule_warnings
from hilbo.study.analysis.highest_answer import HighestAnswer
from hilbo.study.analysis.model_check import check_sentences
from hilbo.study.analysis.region import Region, region_content, region_sentences
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import MANY, Aggregate, asked_variance, other_inference
from hilbo.study.estimate.learnt import effect_content, learnt_content, learnt_sentences
from hilbo.study.estimate.location import goal_sentences, location_notes, location_sentences
from hilbo.study.estimate.optimum import Optimum
from hilbo.study.formats.json_file import Content
from hilbo.study.results.map_netcdf import CELLS, map_dataset, on_grid, write_map

__all__ = [
    "cohort_content",
    "misses",
    "moved",
    "optima_table",
    "optimum_content",
    "population_grid",
    "result",
    "save_figures",
    "versions",
    "write_grid",
    "write_numbers",
    "write_results",
]

_PIXELS = 130  # of the page for an inch of a figure, so that all have letters of one size


def misses(
    study: Study, x: Float[Array, "... d"] | Float[np.ndarray, "... d"], truth: Float[np.ndarray, " d"]
) -> tuple[np.ndarray, np.ndarray | None]:
    """NRMSE of points (..., d) to the true optimum (d,), all in the unit cube: (...,) over the searched parameters, and
    (...,) with the derived K0 as a further parameter.

    The second is None without mechanics. An error of K0 is a fraction of `K0_range`.
    """
    x = np.asarray(x)
    errors = np.asarray(nrmse(x, truth, study.gp.kernel.levels))
    if study.space.mechanics is None:
        return errors, None
    *K0, true_K0 = (Rendering.at(study.space, row).parameters["K0"] for row in (*x.reshape(-1, x.shape[-1]), truth))
    K0_error = (np.array(K0).reshape(errors.shape) - true_K0) / K0_range(study.space)
    d = x.shape[-1]
    return errors, np.asarray(np.sqrt((d * errors**2 + K0_error**2) / (d + 1)))


def versions() -> dict[str, str]:
    """Versions of hilbo, Python and the numerical packages, JAX's first device, and the default float type, as
    texts.
    """
    packages = ("hilbo", "jax", "jaxlib", "numpy", "equinox", "optimistix")
    installed = {name: importlib.metadata.version(name) for name in packages}
    return installed | {
        "python": platform.python_version(),
        "device": str(jax.devices()[0]),
        "dtype": str(jnp.result_type(float)),
    }


def result(
    study: Study,
    aggregate: Aggregate,
    seed: int,
    truth: Float[np.ndarray, " d"] | None = None,
    people: People | None = None,
    left_out: Sequence[str] = (),
    *,
    region: Region | None = None,
    check: Content | None = None,
    highest: HighestAnswer | None = None,
) -> Content:
    """The content of result.json of an aggregation; nothing is written.

    **Arguments:** `truth`: true optimum (d,) in the unit cube, if known; `people`: of `people_of`, else computed here;
    `left_out`: sentences on excluded participants, which become the first warnings; `region`, `check`,
    `highest`: of `CohortResults`. With more than `MANY` participants, "participants" is the record `people` itself,
    which `write_result` writes piece by piece. Raises `InputError` for a `truth` without individual optima.
    """
    people = people_of(study, aggregate) if people is None else people
    best = aggregate.optimum
    content = {
        "optimum": optimum_content(study, best) | {"location": _location(study, aggregate, study.rule, best)},
        "participants": list(people.entries()) if len(people.names) <= MANY else people,
        "alternatives": {
            name: optimum_content(study, optimum) | {"location": _location(study, aggregate, name, optimum)}
            for name, optimum in aggregate.alternatives.items()
        },
        "mean_of_optima": None if aggregate.own is None else _mean_of_optima(study, aggregate.mean_of_optima),
        "rule": study.rule,
        "learnt": learnt_content(study, people.names, aggregate.map),
        "random_effect": _random_effect(study, aggregate),
        "heterogeneity": heterogeneity(aggregate),
        "inference": study.inference,
        "study": study.file.hash,
        "meaning": study.file.meaning,
        "goal": study.goal_label,
        "seed": seed,
        "versions": versions(),
    }
    other = other_inference(study)
    if other in aggregate.alternatives:
        content["other_inference"] = {"inference": other} | moved(study, aggregate.alternatives[other].x, best.x)
    warnings = [*left_out, *_not_converged(people), *rule_warnings(study, aggregate), *learnt_sentences(study)]
    warnings += goal_sentences(study, aggregate.cohort.trials)
    warnings += location_sentences(study, best.x, best.sd, aggregate.asked_variance)
    content["warnings"] = warnings + region_sentences(region, study.one_optimum) + check_sentences(check)
    content["optimum_region"] = region_content(study, region)
    content["model_check"] = check
    content["highest_answer"] = None if highest is None else highest._asdict()
    if truth is not None:
        content["truth"] = _truth(study, aggregate, truth)
    return content


def _random_effect(study: Study, aggregate: Aggregate) -> Content | None:
    """Content on the random effect, of the study's own map or else of the first alternative map that has one; None if
    there is none.
    """
    maps = (aggregate.map, *aggregate.maps.values())
    map_ = next((each for each in maps if each.effects is not None), None)
    return None if map_ is None else effect_content(study, aggregate.cohort, map_)


def _mean_of_optima(study: Study, mean: Float[Array, " d"]) -> Content:
    """Parameters and passivity margin of the mean (d,) of the individual optima, a point that no participant was tested
    at.
    """
    rendering = Rendering.at(study.space, mean)
    return {"parameters": rendering.shown, "passivity_margin": rendering.margin}


def _location(study: Study, aggregate: Aggregate, name: str, optimum: Optimum) -> list[str]:
    """Notes on an optimum's location (range limit, constraint, extrapolation); empty if there are none.

    `name`: the aggregation method whose map gave the optimum; without a map of that name extrapolation is not checked.
    """
    map_ = aggregate.maps.get(name)
    asked = None if map_ is None else asked_variance(map_, aggregate.cohort)
    return location_notes(study, optimum.x, optimum.sd, asked)


def moved(study: Study, x: Float[Array, " d"], start: Float[Array, " d"]) -> Content:
    """Distance from the optimum `start` to the optimum `x`, both (d,) in the unit cube: `nrmse`, and `moved`, by
    parameter.

    Each parameter, derived K0 too, has the difference `by` in its unit, and `percent` of its range. Of levels, `by` is
    a text and a change is 100 %.
    """
    target, origin = (Rendering.at(study.space, point).shown for point in (x, start))
    levels = study.gp.kernel.levels
    percent = 100 * differences(levels, np.asarray(x), np.asarray(start))
    share = dict(zip(study.space.names, percent.tolist(), strict=True))
    if study.space.mechanics is not None:
        share = {"K0": 100 * (target["K0"] - origin["K0"]) / K0_range(study.space)} | share
    ways = {name: {"by": _difference(origin[name], target[name]), "percent": share[name]} for name in target}
    return {"nrmse": float(nrmse(x, start, levels)), "moved": ways}


def _difference(start: float | str, end: float | str) -> float | str:
    """Difference `end` - `start` of two values; of two levels the text "A to B", or "the same"."""
    if isinstance(start, str) or isinstance(end, str):
        return "the same" if start == end else f"{start} to {end}"
    return end - start


def _not_converged(people: People) -> list[str]:
    """A list with one warning that names the participants whose fit did not converge, at most 10 by name; an empty list
    if all converged.
    """
    names = [name for name, good in zip(people.names, people.certificate["converged"], strict=True) if not good]
    if not names:
        return []
    one = len(names) == 1
    shown = names if len(names) <= 10 else [*names[:10], f"{len(names) - 10:,} others"]
    return [
        f"The {'fit' if one else 'fits'} of {', '.join(shown)} did not reach {'its' if one else 'their'} tolerance, so"
        " that the results may be off by more than rounding; see the certificate of each fit in result.json."
    ]


def optimum_content(study: Study, optimum: Optimum) -> Content:
    """An optimum as an entry of result.json: parameters in physical units, `unit` (its point in the unit cube), mean
    and sd of the latent score, class probabilities by response, and passivity margin (N·s/m, None without mechanics).
    """
    labels, rendering = study.responses, Rendering.at(study.space, optimum.x)
    return {
        "parameters": rendering.shown,
        "unit": np.asarray(optimum.x).tolist(),
        "mean": float(optimum.mean),
        "sd": float(optimum.sd),
        "class_probabilities": dict(zip(labels, np.asarray(optimum.class_probabilities).tolist(), strict=True)),
        "passivity_margin": rendering.margin,
    }


def _truth(study, aggregate, truth):
    """Entry `truth` of result.json: NRMSE to the known optimum `truth` (d,) in the unit cube, of the map's optimum, the
    alternatives and the mean of the individual optima; quartiles over the individual optima, each with and without K0.

    Also mean and sd of the number of responses per participant that are the goal; the sd is None for one participant.
    Raises `InputError` if individual optima were not computed.
    """
    individual_misses, individual_misses_with_K0 = misses(study, aggregate.individuals.x, truth)
    quartiles = np.percentile(individual_misses, [25, 50, 75]).tolist()
    claims = {"aggregate": aggregate.optimum.x, "mean_of_optima": aggregate.mean_of_optima}
    claims |= {name: optimum.x for name, optimum in aggregate.alternatives.items()}
    table = {}
    for name, x in claims.items():
        plain, with_K0 = misses(study, x, truth)
        table[name] = {"nrmse": float(plain), "nrmse_with_K0": None if with_K0 is None else float(with_K0)}
    individuals = {
        "quartiles": quartiles,
        "with_K0": None
        if individual_misses_with_K0 is None
        else np.percentile(individual_misses_with_K0, [25, 50, 75]).tolist(),
    }
    trials = aggregate.cohort.trials
    top = ((np.asarray(trials.q) == study.goal.category) & np.asarray(trials.mask)).sum(axis=1)
    return {
        "parameters": Rendering.at(study.space, truth).shown,
        "nrmse": table,
        "individuals": individuals,
        "top_answers": {"mean": float(top.mean()), "sd": float(top.std(ddof=1)) if len(top) > 1 else None},
    }


def write_results(
    population: CohortResults,
    folder: Path,
    truth: Float[np.ndarray, " d"] | None = None,
    say=lambda text: None,
    *,
    left_out: Sequence[str] = (),
    selection: str = "",
    comparison: Content | None = None,
    pictures: Pictures | None = None,
    grid: xr.Dataset | None = None,
) -> Content:
    """Write the whole results folder, which must exist; return the content of result.json.

    **Arguments:** `truth`: true optimum (d,) in the unit cube, if known; `say`: called with a text at each step;
    `left_out`: sentences on excluded participants; `selection`, `comparison`: as for `page.results_page`, `pictures`:
    figures of the comparison that are already written; `grid`: of `population_grid`, else computed here.
    """
    study, aggregate = population.study, population.aggregate
    people = people_of(study, aggregate)
    content = cohort_content(population, truth, people, left_out)
    say("computing the population map on a grid")
    grid = population_grid(population) if grid is None else grid
    write_numbers(content, people, grid, folder)
    say("drawing figures and writing the report")
    figures, shown = _figures(population, truth, grid)
    pictures = save_figures(figures, folder) | (pictures or {})
    how = how_aggregated(aggregate.map)
    page = results_page(study, content, pictures, people, selection=selection, comparison=comparison, how=how, **shown)
    (folder / "report.html").write_text(page, encoding="utf-8")
    return content


def population_grid(population: CohortResults) -> xr.Dataset:
    """Mean and variance of the population map on a grid. The grid is coarse (`coarse_cells`) for a population without
    progress over trials, that is, one with many participants.
    """
    cells = CELLS if population.following is not None else coarse_cells(population.study)
    return map_dataset(population.study, population.aggregate.surface, cells)


def cohort_content(
    population: CohortResults, truth: Float[np.ndarray, " d"] | None, people: People, left_out: Sequence[str] = ()
) -> Content:
    """The content of result.json of an analysed cohort; arguments as for `result`. Nothing is written."""
    study, aggregate, seed = population.study, population.aggregate, population.seed
    analysed = {"region": population.region, "check": population.check, "highest": population.highest}
    return result(study, aggregate, seed, truth, people, [*left_out, *population.doubts], **analysed)


def write_numbers(content: Content, people: People, grid: xr.Dataset, folder: Path) -> None:
    """Write result.json (with its digest), optima.csv and map.nc into an existing folder; adds attributes to `grid`."""
    write_result(content, folder, sealed=True)
    optima_table(content, people).to_csv(folder / "optima.csv", index=False)
    write_grid(content, grid, folder)


def write_grid(content: Content, grid: xr.Dataset, folder: Path) -> None:
    """Write map.nc into an existing folder; the aggregation method and the optimum's parameters (as JSON) become
    attributes of `grid` itself.
    """
    grid.attrs |= {"rule": content["rule"], "optimum": json.dumps(content["optimum"]["parameters"])}
    write_map(grid, folder / "map.nc")


def save_figures(figures: Mapping[str, Any], folder: Path) -> Pictures:
    """Write matplotlib figures by name as PNG, SVG and PDF into an existing folder.

    Returns for each its PNG in base64 and its width on a page in pixels, for `page`.
    """
    widths = {name: str(round(_PIXELS * figure.get_figwidth())) for name, figure in figures.items()}
    return {
        name: {"png": base64.b64encode(png).decode(), "width": widths[name]}
        for name, png in write_figures(figures, folder).items()
    }


def optima_table(content: Content, people: People) -> pd.DataFrame:
    """The rows of optima.csv: the map's optimum (`source` "aggregate"), the alternatives', and the individual ones.

    The location notes of the first two are joined by semicolons; individual optima have none.
    """
    claims = {"aggregate": content["optimum"]} | content["alternatives"]
    rows = [
        {"source": name} | claim["parameters"] | {"location": "; ".join(claim["location"])}
        for name, claim in claims.items()
    ]
    return pd.concat([pd.DataFrame(rows), people.table()])


def _figures(
    population: CohortResults, truth: Float[np.ndarray, " d"] | None, grid: xr.Dataset
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Matplotlib figures of an aggregation by name, and further arguments of `results_page`: `drawn` for a large
    population, else `halves`. For others than large ones it waits for the progress over trials to be computed. `truth`
    (d,) is marked if known.
    """
    from hilbo.report.figures import maps
    from hilbo.report.figures.effects import effects_figure
    from hilbo.report.figures.goal_map import goal_map
    from hilbo.report.figures.progress import progress_figure

    study, aggregate = population.study, population.aggregate
    if population.following is None:
        figures, drawn = figures_of_many(study, aggregate, grid)
        return figures, {"drawn": drawn}
    best = np.asarray(aggregate.optimum.x)
    figures = {
        "goal-map": goal_map(study, aggregate, population.region),
        "map": maps.map_slices(study, aggregate.surface, best, population.cohort),
        "progress": progress_figure(study, population, truth),
        "slices": maps.slices_after(study, population.progress),
    }
    if not on_grid(study.space):
        figures["effects"] = effects_figure(study, effects_of(study, aggregate.surface, best, population.seed), best)
    if study.space.dim > 1:
        marks = {"population map": best, "mean of optima": np.asarray(aggregate.mean_of_optima)}
        marks |= {} if truth is None else {"truth": truth}
        figures["optima"] = maps.optima_scatter(study, np.asarray(aggregate.individuals.x), marks)
    return figures, {"halves": population.progress.splits}
