"""Tables of a study's results: optima, convergence, tolerance intervals, distances from the passive boundary."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pandas as pd

from hilbo.population.rules.registry import RULES
from hilbo.report.results import moved
from hilbo.search.rendering import Rendering
from hilbo.study.analysis.analysis import Analysis
from hilbo.study.folder import Reference

__all__ = ["alternatives_table", "convergence_table", "table_1", "tolerance_table"]


def table_1(analysis: Analysis, reference: Reference | None) -> pd.DataFrame:
    """Population optimum and mean of the individual optima, by parameter, next to the reference if there is one (paper,
    table I). Columns `parameter`, `reference`, `aggregate`, `mean_of_optima`, `sd_of_optima`, `error_percent`,
    `mean_error_percent`.

    `reference`: None leaves its column and the errors out. Errors are absolute, in per cent of the range; the standard
    deviation is NaN for one participant and for levels.
    """
    study, aggregate = analysis.study, analysis.aggregate
    mean, best = aggregate.mean_of_optima, aggregate.optimum.x
    individual_sets = pd.DataFrame([Rendering.at(study.space, x).shown for x in np.asarray(aggregate.individuals.x)])
    ours, theirs = (Rendering.at(study.space, x).shown for x in (best, mean))
    table = pd.DataFrame(
        {"parameter": list(ours), "aggregate": list(ours.values()), "mean_of_optima": list(theirs.values())}
    )
    spread = individual_sets.std(ddof=1, numeric_only=True)  # NaN of one; levels have none
    table["sd_of_optima"] = [spread.get(name, np.nan) for name in ours]
    if reference is not None:
        table.insert(1, "reference", list(Rendering.at(study.space, reference.x).shown.values()))
        for name, x in (("error_percent", best), ("mean_error_percent", mean)):
            ways = moved(study, x, jnp.asarray(reference.x))["moved"]
            table[name] = [abs(ways[parameter]["percent"]) for parameter in ours]
    return table


def convergence_table(analysis: Analysis) -> pd.DataFrame:
    """After each number of trials (paper, figures 5 and 7b): NRMSE of the population's optimum to its last, of
    individual optima to theirs (median, quartiles), of both to the optimum of half of the participants, and cumulative
    responses that are the goal (median, quartiles).

    Columns `trials`, `population`, `halves`, `individuals_to_half`, and `individuals_` and `top_answers_` with `low`,
    `median` and `high`. Those on halves are missing if there were too few participants to split.
    """
    study, counts = analysis.study, analysis.progress.counts
    population_errors, individual_errors = analysis.progress.to_end()
    top = np.asarray((analysis.cohort.trials.q == study.goal.category) & analysis.cohort.trials.mask)
    so_far = np.cumsum(top, axis=1)[:, counts - 1]
    table = pd.DataFrame({"trials": counts, "population": population_errors})
    if analysis.progress.splits:
        table["halves"] = np.median(analysis.progress.halves, axis=1)
        table["individuals_to_half"] = np.nanmedian(
            np.where(np.isnan(individual_errors), np.nan, analysis.progress.individual_to_half), axis=1
        )
    for name, values in (("individuals", individual_errors.T), ("top_answers", so_far)):
        table[[f"{name}_low", f"{name}_median", f"{name}_high"]] = np.nanpercentile(values, [25, 50, 75], axis=0).T
    return table


def tolerance_table(analysis: Analysis) -> pd.DataFrame:
    """Tolerance intervals by parameter under fixed and under optimised hyperparameters, with bootstrap intervals of
    their ends (paper, section VII).

    An interval is NaN where the goal is not the likeliest response at the optimum; `draws_without`: share of
    resamples without an interval, 1 where no resample had one.
    """
    rows = []
    for name, reading in (("fixed", analysis.fixed), ("optimised", analysis.optimised)):
        for parameter, (interval, ends) in reading.tolerances.items():
            row: dict[str, Any] = {"hyperparameters": name, "parameter": parameter}
            if interval is not None:
                row |= {
                    "low": interval.low,
                    "high": interval.high,
                    "low_end": interval.low_end,
                    "high_end": interval.high_end,
                }
            if ends is not None:
                row |= {
                    "low_from": ends.low[0],
                    "low_to": ends.low[1],
                    "high_from": ends.high[0],
                    "high_to": ends.high[1],
                }
            rows.append(row | {"draws_without": 1.0 if ends is None else ends.lost})
    columns = ["hyperparameters", "parameter", "low", "high", "low_end", "high_end"]
    return pd.DataFrame(rows, columns=[*columns, "low_from", "low_to", "high_from", "high_to", "draws_without"])


def alternatives_table(analysis: Analysis) -> pd.DataFrame:
    """All estimates that could be presented as the optimum (name in `optimum`), a row each: parameters, latent score
    (`mean`, `sd`), probability of the goal (`p_top`), and with mechanics `passivity_margin` (N·s/m; negative is not
    passive).

    Means of optima and sets have no score. Only methods that predict a new participant (`Rule.predicts`) have the
    probability.
    """
    study, aggregate = analysis.study, analysis.aggregate
    claims: dict[str, tuple[Any, Any]] = {"population": (aggregate.optimum.x, aggregate.optimum)}
    claims |= {f"population, {name}": (other.x, other) for name, other in aggregate.alternatives.items()}
    learns = RULES[study.rule].learns
    other = (analysis.fixed if learns else analysis.optimised).aggregate.optimum
    claims[f"population, {'medians of the priors' if learns else 'optimised hyperparameters'}"] = (other.x, other)
    claims["mean of the individual optima"] = (aggregate.mean_of_optima, None)
    if analysis.sets is not None:
        claims |= {name: (analysis.sets.x[i], None) for i, name in enumerate(("best", "mid", "worst"))}
    rows = []
    for name, (x, optimum) in claims.items():
        rendering = Rendering.at(study.space, x)
        row = {"optimum": name} | rendering.shown
        if optimum is not None:
            row |= {"mean": float(optimum.mean), "sd": float(optimum.sd)}
            rule = RULES.get(name.removeprefix("population, "), RULES[study.rule])
            row["p_top"] = float(optimum.class_probabilities[study.goal.category]) if rule.predicts else None
        rows.append(row if study.space.mechanics is None else row | {"passivity_margin": rendering.margin})
    return pd.DataFrame(rows)
