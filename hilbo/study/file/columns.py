"""The data dictionary: unit and meaning of each column of the tables that `hilbo export` and `hilbo report` write.

Sidecars of an export, dictionary.csv of a report, the page docs/guides/columns.md, and the names that no parameter may
have are all taken from here. Loads no JAX.
"""

from hilbo.search.box import Box
from hilbo.study.file.trial_flags import FLAGS

__all__ = ["EXPORTED", "REPORTED", "UNWRITTEN", "Meaning", "meanings", "presented_column"]

Meaning = tuple[str, str]
"""Unit ("" where there is none), and description."""
UNWRITTEN = "see the log"
"""Replaces a text that a spreadsheet would run; the log has the text."""


def _by_the_study(constrained: bool = True, rendered: bool = True, damped: bool = True) -> dict[str, Meaning]:
    """Reasons of an end of a tolerance interval, and flags of a location, by what the study has."""
    ends, places = ["another response", "the range"], ["range limit"]
    if constrained:
        ends, places = [*ends, "a constraint"], [*places, "constraint boundary"]
    if rendered:
        ends, places = [*ends, "the passive boundary"], [*places, "passive boundary"]
    if damped:
        ends, places = [*ends, "the range of effective damping"], [*places, "limit of effective damping"]
    return {
        "low_end": ("", f"reason of the lower end: {', '.join(ends[:-1])} or {ends[-1]}"),
        "location": ("", f"flags of the location: {', '.join(places)}, extrapolation; empty: none"),
    }


_BY_THE_STUDY = _by_the_study()
_WHERE: dict[str, Meaning] = {
    "participant": ("", "pseudonymous id"),
    "session": ("", "label of the session"),
    "phase": ("", "warm-up, optimisation, repeat, validation or aggregate-best"),
    "material": ("", "reference material"),
    "trial": ("", "number of the trial, counted within participant, session, phase and material"),
}
_TIMES: dict[str, Meaning] = {
    "response_time": ("s", "time from the question to the response, by the browser's clock"),
    "answered_at": ("s", "time of the response since 1970, by the server's clock"),
}
_DEVICE: dict[str, Meaning] = {
    "flags": ("", f"flags of the device's telemetry during the trial ({', '.join(FLAGS)}), by spaces; empty: none"),
    "telemetry_samples": ("samples", "from the first step to the response; empty where none were recorded"),
}
_STATUS = "answered, undone, void, dropped, left out (by a person, after the device stopped it twice) or pending"
EXPORTED: dict[str, dict[str, Meaning]] = {
    "trials": _WHERE
    | {
        "response": ("", "the participant's response"),
        "voided": ("", "1 if the response does not count"),
        "status": ("", _STATUS),
        "unblinded": ("", "what showed the participant the parameters; empty where nothing did"),
    }
    | _TIMES
    | _DEVICE,
    "validation": _WHERE
    | {
        "set_a": ("", "parameter set on side a"),
        "set_b": ("", "parameter set on side b"),
        "first": ("", "set that was presented first"),
        "class_a": ("", "response to set_a"),
        "class_b": ("", "response to set_b"),
        "preferred": ("", "set that was preferred"),
    }
    | _TIMES
    | {
        "shortest_time": (
            "s",
            "shortest time from a question to its response; below 0.5 perhaps a doubled key",
        )
    }
    | _DEVICE,
    "sets": {
        "set_id": ("", "name of the parameter set"),
        "source": ("", "aggregate, sysid or individual:PARTICIPANT"),
        "role": ("", "best, mid or worst of the map that the set was read from; empty for others"),
        "material": _WHERE["material"],
        "N": ("samples", "past samples that are rendered"),
        "T": ("s", "time between two samples"),
        "memory": ("", "short or full: how the past is rendered"),
        "states": ("", "number of exponentials of full memory"),
    },
    "presentations": _WHERE
    | {
        "status": ("", _STATUS),
        "presentations": ("", "how often the trial was presented"),
        "proposed_at": ("s", "time of the proposal since 1970, by the server's clock"),
        "voided_by": ("", "role that voided the trial"),
        "voided_reason": ("", f"why the trial does not count; '{UNWRITTEN}' for a text that a spreadsheet would run"),
    }
    | _TIMES,
    "sessions": {
        "participant": _WHERE["participant"],
        "session": _WHERE["session"],
        "phases": ("", "phases of the session, in order"),
        "plan": ("", "hash of the plan that the session was held by; empty where it was held by none"),
        "seed": ("", "seed of the session's choices"),
        "pauses": ("pauses", "times of at least 60 s without a presentation or response, breaks and restarts included"),
        "longest_pause": ("s", "duration of the longest of them; 0 where there was none"),
    },
}
"""Table of an export (`hilbo.session.export`) -> column -> meaning."""

_INTERVAL: dict[str, Meaning] = {
    "low": ("", "lower end of the 95 % interval"),
    "high": ("", "upper end of the 95 % interval"),
}
_REGRESSION: dict[str, Meaning] = {
    "term": ("", "term of the coefficient"),
    "estimate": ("logit", "maximum-likelihood coefficient"),
    "errors": ("", "method of the standard errors: iid, clustered by participant, two-way"),
    "std_error": ("logit", "standard error"),
    "statistic": ("", "estimate divided by its standard error"),
    "degrees_of_freedom": ("", "of the t distribution of p_value and interval"),
    "p_value": ("", "two-sided"),
    **_INTERVAL,
    "odds_ratio": ("", "exponential of the estimate"),
    "odds_low": ("", "lower end of its 95 % interval"),
    "odds_high": ("", "upper end of its 95 % interval"),
    "assumes": ("", "assumption of these errors about the responses"),
}
_RATE: dict[str, Meaning] = {
    "wins": ("comparisons", "in which the set (or the aggregate's) was preferred"),
    "losses": ("comparisons", "in which the other was preferred"),
    "ties": ("comparisons", "without a preference; not part of the rate"),
    "rate": ("share", "wins divided by wins plus losses"),
    "errors": ("", "method of the interval"),
    "p_value": ("", "of a rate of one half, two-sided"),
    **_INTERVAL,
    "assumes": ("", "assumption of the interval about the responses"),
}
_PEOPLE: dict[str, Meaning] = {
    "participant": _WHERE["participant"],
    "trials": ("responses", "number of the participant's responses"),
    "categories": ("responses", "number of different responses that the participant used"),
    "pairs": ("pairs", "disjoint pairs of responses to renderings within 2 % of each other"),
    "chance": ("share", "agreement of such pairs expected by chance"),
    "surprise": ("nats", "mean negative log probability of each response, given the participant's earlier ones"),
    "left_out": ("", "why the study's exclusion rule leaves the participant out; empty: included"),
}
for _name, _words, _unit in (
    ("consistency", "share of pairs with the same response", "share"),
    ("lapse", "share of responses that cannot be distinguished from guesses, given the earlier ones", "share"),
    ("drift", "shift of the latent score from the first to the last trial", "prior sd"),
):
    _PEOPLE |= {_name: (_unit, f"{_words}; empty: not identifiable from the responses")}
    _PEOPLE |= {f"{_name}_{end}": (_unit, f"{end} end of its 95 % interval") for end in ("low", "high")}
_CONVERGENCE: dict[str, Meaning] = {
    "trials": ("trials", "number of trials of each participant that are used"),
    "population": ("NRMSE", "distance of the population optimum to its last location, in ranges"),
    "halves": ("NRMSE", "median distance of the optimum of one half of the participants to the other half's final one"),
    "individuals_to_half": ("NRMSE", "median distance of individual optima to that of a half without the participant"),
}
for _name, _words, _unit in (
    ("individuals", "distance of individual optima to their last location", "NRMSE"),
    ("top_answers", "responses in the highest category so far", "responses"),
):
    for _end, _side in (("low", "lower quartile"), ("median", "median"), ("high", "upper quartile")):
        _CONVERGENCE[f"{_name}_{_end}"] = (_unit, f"{_words}, {_side} over participants")
_TOLERANCE: dict[str, Meaning] = {
    "hyperparameters": ("", "fixed: the study's, or learnt by its method; optimised: by maximum evidence"),
    "parameter": ("", "name of the parameter, whose unit the ends have"),
    "low": ("parameter's", "lower end of the tolerance interval"),
    "high": ("parameter's", "upper end of the tolerance interval"),
    "low_end": _BY_THE_STUDY["low_end"],
    "high_end": ("", "reason of the upper end, as low_end"),
    "draws_without": ("share", "bootstrap resamples of participants without an interval; empty: of one participant"),
} | {
    f"{end}_{side}": ("parameter's", f"{side} 95 % of bootstrap resamples, {end} end")
    for end in ("low", "high")
    for side in ("from", "to")
}
REPORTED: dict[str, dict[str, Meaning]] = {
    "optima": {
        "source": ("", "aggregate, an alternative method or inference, or individual:PARTICIPANT"),
        "location": _BY_THE_STUDY["location"],
    },
    "table_I": {
        "parameter": ("", "name of the parameter, whose unit the values have"),
        "reference": ("parameter's", "system identification, or the truth of a simulated study"),
        "aggregate": ("parameter's", "optimum of the population map"),
        "error_percent": ("% of range", "distance of that optimum to the reference"),
        "mean_of_optima": ("parameter's", "mean of the individual optima"),
        "sd_of_optima": ("parameter's", "their standard deviation"),
        "mean_error_percent": ("% of range", "distance of the mean to the reference"),
    },
    "convergence": _CONVERGENCE,
    "tolerance": _TOLERANCE,
    "people": _PEOPLE,
    "alternatives": {
        "optimum": ("", "optimum or set"),
        "mean": ("prior sd", "posterior mean of the latent score there"),
        "sd": ("prior sd", "its standard deviation"),
        "p_top": ("probability", "of the highest response of a new participant"),
        "passivity_margin": ("N.s/m", "damping of the device minus what passivity needs; negative: not passive"),
    },
    "comparison": {
        "rule": ("", "aggregation method"),
        "method": ("", "exact: from all responses at once; by points: participant by participant at each point"),
        "negative_log_density": (
            "nats",
            "mean over responses of held-out participants, predicted from the other participants' responses and their"
            " own earlier ones",
        ),
        "negative_log_density_error": ("nats", "its standard error, clustered by participant"),
        "difference": ("nats", "of that density to the best method's"),
        "difference_error": ("nats", "standard error of the difference, paired by response, clustered by participant"),
        "central_95": ("share", "responses within the central 95 % of their prediction"),
        "central_95_error": ("share", "its standard error, clustered by participant"),
        "z2": ("", "mean square of the normal scores; 1: calibrated, more: overconfident"),
        "covered": ("share", "of the space where the map's sd is below 80 % of the prior's"),
        "optimum_sd": ("prior sd", "standard deviation of the map at its optimum"),
        "most_influential": ("", "participant whose responses change the map most"),
        "refused": ("", "why the method gives no map; empty: it does"),
    },
    "confusion": {"set": ("", "set that was presented; the other columns count the responses to it")},
    "preferences": {
        "set": ("", "first set of the pair"),
        "over": ("", "second set of the pair"),
        "comparisons": ("comparisons", "number of comparisons of the two"),
    }
    | _RATE,
    "aggregate_best": _RATE,
    "aggregate_best_people": {"name": _WHERE["participant"]} | _RATE,
    **dict.fromkeys(("table_II", "table_III", "table_IV"), _REGRESSION),
}
"""Table of a report -> column -> meaning."""
_TABLES = EXPORTED | REPORTED
_K0: Meaning = ("N/mm", "stiffness of the spring, derived from the effective stiffness")


def presented_column(side: str, name: str) -> str:
    """The column of what was presented on side a or b; no parameter's own column, and no other, is called so."""
    return f"presented_{side}_{name}"


def meanings(table: str, space: Box) -> dict[str, Meaning]:
    """The columns of a table (of `EXPORTED` or `REPORTED`) in a study with this search space. A table's own column
    comes before a parameter of that name."""
    units = {p.name: (p.unit, f", {p.range_words}" if p.levels else "") for p in space.parameters}
    columns = {"K0": _K0} | {name: (unit, f"value of the parameter{levels}") for name, (unit, levels) in units.items()}
    for side in "ab":
        for name, (unit, levels) in units.items():
            columns[presented_column(side, name)] = (unit, f"value confirmed as presented on side {side}{levels}")
    mechanics = space.mechanics
    damped = mechanics is not None and mechanics.effective_damping is not None
    here = _by_the_study(bool(space.constraints), mechanics is not None, damped)
    return columns | _TABLES[table] | {name: here[name] for name in here if name in _TABLES[table]}
