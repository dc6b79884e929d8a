"""The data dictionary of a report: what every column of its CSV tables means, and in which unit.

A table that has a column without an entry is an error, so that no column is written that nobody explains.
"""

from collections.abc import Mapping

import pandas as pd

from hilbo.study.config import Study

__all__ = ["dictionary"]

_INTERVAL = {"low": ("", "lower end of the 95 % interval"), "high": ("", "upper end of the 95 % interval")}
_REGRESSION = {
    "term": ("", "what the coefficient belongs to"),
    "estimate": ("logit", "maximum-likelihood coefficient"),
    "errors": ("", "how standard errors were computed: iid, clustered by person, two-way"),
    "std_error": ("logit", "standard error"),
    "statistic": ("", "estimate over its standard error"),
    "degrees_of_freedom": ("", "of the t distribution that p and interval are from"),
    "p_value": ("", "two-sided"),
    **_INTERVAL,
    "odds_ratio": ("", "exponential of the estimate"),
    "odds_low": ("", "lower end of its 95 % interval"),
    "odds_high": ("", "upper end of its 95 % interval"),
    "assumes": ("", "what these errors assume of the answers"),
}
_RATE = {
    "wins": ("comparisons", "in which the set (or the aggregate's) was preferred"),
    "losses": ("comparisons", "in which the other was preferred"),
    "ties": ("comparisons", "without a preference; left out of the rate"),
    "rate": ("share", "wins among wins and losses"),
    "errors": ("", "how the interval was computed"),
    "p_value": ("", "against a rate of one half, two-sided"),
    **_INTERVAL,
    "assumes": ("", "what the interval assumes of the answers"),
}
_MAP = {
    "mean": ("prior sd", "posterior mean of the latent score there"),
    "sd": ("prior sd", "its standard deviation"),
    "p_top": ("probability", "of the highest answer of a new participant"),
    "passivity_margin": ("N.s/m", "damping of the device more than passivity needs; negative: not passive"),
}
_PEOPLE = {
    "participant": ("", "identifier, as in the trial table"),
    "trials": ("answers", "how many the participant gave"),
    "categories": ("answers", "how many different ones the participant used"),
    "pairs": ("pairs", "disjoint pairs of answers to renderings within 2 %"),
    "chance": ("share", "agreement of such pairs expected by chance"),
    "surprise": ("nats", "mean of minus the log probability of each answer, from the participant's earlier ones"),
    "left_out": ("", "why the study's rule leaves the participant out; empty: kept"),
}
for _name, _words, _unit in (
    ("consistency", "share of pairs with the same answer", "share"),
    ("lapse", "share of answers that the participant's own earlier answers cannot tell from a guess", "share"),
    ("drift", "shift of the latent score from the first to the last trial", "prior sd"),
):
    _ends = {f"{_name}_{end}": (_unit, f"{end} end of its 95 % interval") for end in ("low", "high")}
    _PEOPLE |= {_name: (_unit, f"{_words}; empty: the answers do not tell")} | _ends
_COMPARISON = {
    "rule": ("", "rule of aggregation"),
    "method": ("", "exact: from all answers at once; by points: person by person at each point"),
    "negative_log_density": (
        "nats",
        "mean over answers of people left out, predicted from other people's answers and the person's own earlier ones",
    ),
    "negative_log_density_error": ("nats", "its standard error, clustered by person"),
    "difference": ("nats", "of that density to the best rule's"),
    "difference_error": ("nats", "standard error of the difference, paired by answer and clustered by person"),
    "central_95": ("share", "answers within the central 95 % of their prediction"),
    "central_95_error": ("share", "its standard error, clustered by person"),
    "z2": ("", "mean square of the normal scores; 1: calibrated, more: too sure"),
    "covered": ("share", "of the space where the map's sd is below 80 % of the prior's"),
    "optimum_sd": ("prior sd", "standard deviation of the map at its optimum"),
    "most_influential": ("", "whose answers move the map most"),
    "refused": ("", "why the rule gives no map; empty: it does"),
}
_CONVERGENCE = {
    "trials": ("trials", "everybody's first so many"),
    "population": ("NRMSE", "distance of the population optimum to its last place, in ranges"),
    "halves": (
        "NRMSE",
        "median distance of one half of the people's optimum to the other half's after all trials",
    ),
    "individuals_to_half": ("NRMSE", "median distance of individual optima to that of a half without the person"),
}
for _name, _words, _unit in (
    ("individuals", "distance of individual optima to their last place", "NRMSE"),
    ("top_answers", "highest answers so far", "answers"),
):
    for _end, _side in (("low", "lower quartile"), ("median", "median"), ("high", "upper quartile")):
        _CONVERGENCE[f"{_name}_{_end}"] = (_unit, f"{_words}, {_side} over people")
_TOLERANCE = {
    "hyperparameters": ("", "fixed: the study's, or what its rule learnt; optimised: by maximum evidence"),
    "parameter": ("", "name of the parameter, whose unit the ends have"),
    "low": ("parameter's", "lower end of the tolerance interval"),
    "high": ("parameter's", "upper end"),
    "low_end": ("", "what ends it there"),  # and in `_bounds` what that may be
    "high_end": ("", "the same of the upper end"),
    "draws_without": ("share", "bootstrap resamples of the people without an interval; empty: of one person"),
} | {
    f"{end}_{side}": ("parameter's", f"{side} 95 % of bootstrap resamples, {end} end")
    for end in ("low", "high")
    for side in ("from", "to")
}
_TABLE_1 = {
    "parameter": ("", "name of the parameter, whose unit the values have"),
    "reference": ("parameter's", "system identification, or the truth of a simulated study"),
    "aggregate": ("parameter's", "optimum of the population map"),
    "error_percent": ("% of range", "distance of that optimum to the reference"),
    "mean_of_optima": ("parameter's", "mean of the individual optima"),
    "sd_of_optima": ("parameter's", "their standard deviation"),
    "mean_error_percent": ("% of range", "distance of the mean to the reference"),
}
_TABLES: dict[str, dict[str, tuple[str, str]]] = {
    "optima": {
        "source": ("", "whose optimum: aggregate, an alternative rule or inference, individual:PARTICIPANT"),
        "location": ("", "what is to be known of where it lies"),
    },
    "table_I": _TABLE_1,
    "convergence": _CONVERGENCE,
    "tolerance": _TOLERANCE,
    "people": _PEOPLE,
    "alternatives": {"optimum": ("", "which optimum or set")} | _MAP,
    "comparison": _COMPARISON,
    "confusion": {"set": ("", "set that was shown; the other columns count the answers to it")},
    "preferences": {
        "set": ("", "one set"),
        "over": ("", "set it was compared with"),
        "comparisons": ("comparisons", "made"),
    }
    | _RATE,
    "aggregate_best": _RATE,
    "aggregate_best_people": {"name": ("", "participant")} | _RATE,
    "table_II": _REGRESSION,
    "table_III": _REGRESSION,
    "table_IV": _REGRESSION,
}


def dictionary(tables: Mapping[str, pd.DataFrame], study: Study) -> pd.DataFrame:
    """A row for each column of the tables: `table`, `column`, `unit`, `meaning`. Raises KeyError for one without."""
    units = {p.name: (p.unit, "value of the parameter") for p in study.space.parameters}
    meanings = {"K0": ("N/mm", "stiffness of the spring, derived from the effective stiffness")} | units
    bounds = _bounds(study)
    own = {name: columns | {key: bounds[key] for key in bounds if key in columns} for name, columns in _TABLES.items()}
    if "confusion" in tables:  # whose first column has another name where an answer is called as it
        counts = {label: ("comparisons", f'in which the answer was "{label}"') for label in study.responses}
        own["confusion"] = counts | {str(tables["confusion"].columns[0]): _TABLES["confusion"]["set"]}
    rows = [
        {"table": f"{name}.csv", "column": column, "unit": unit, "meaning": meaning}
        for name, table in tables.items()
        for column in map(str, table.columns)
        for unit, meaning in [(meanings | own[name])[column]]
    ]
    return pd.DataFrame(rows)


def _bounds(study: Study) -> dict[str, tuple[str, str]]:
    """What is said by what the study has: constraints, a renderer, a range of effective damping."""
    mechanics = study.space.mechanics
    ends, places = ["another answer", "the range"], ["an edge"]
    if study.space.constraints:
        ends, places = [*ends, "a constraint"], [*places, "a constraint"]
    if mechanics is not None:
        ends, places = [*ends, "the passive boundary"], [*places, "the device's border"]
    if mechanics is not None and mechanics.effective_damping is not None:
        ends, places = [*ends, "the range of effective damping"], [*places, "that of effective damping"]
    return {
        "low_end": ("", f"what ends it there: {', '.join(ends[:-1])} or {ends[-1]}"),
        "location": ("", f"what is to be known of where it lies: {', '.join(places)}, an extrapolation"),
    }
