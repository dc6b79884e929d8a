"""The paper's tables II to IV from a validation table, with every kind of error, and the counts behind them.

II: binary logit of the goal ("close" in the paper) against the rest, on whether the set was *best*. III: ordered logit
of the class, coded by its distance from the goal (0), on *best* and *worst*, *mid* being the reference: a negative
coefficient is a shift towards the goal. IV: binary logit of preferring the aggregate's set to an individual's,
an intercept alone. II and III are clustered by participant, IV by participant and by the individual's set.
Ties in IV are modelled (`logits.tied_preferences`): 0 is still "neither is preferred".
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import equinox as eqx
import numpy as np
import pandas as pd

from hilbo.errors import InputError
from hilbo.statistics.columns import check_level
from hilbo.statistics.logits import binary_logit, ordered_logit, tied_preferences
from hilbo.statistics.preferences import classifications, confusion, preference_rates
from hilbo.statistics.regression import Regression
from hilbo.study.tables.parameter_sets import ROLES, role_of, source_kind
from hilbo.study.tables.validation import NONE, RESPONSES, TIE, check_validation, of_material

__all__ = ["PaperTables", "aggregate_comparisons", "paper_tables", "set_sources"]

_OURS, _THEIRS = "Aggregate-Best", "individual"


class PaperTables(eqx.Module):
    """Tables II to IV (None if the data do not allow one), confusion matrix, and preference rates.

    `limits`: one sentence for each part that is missing; the tables have their own `warnings`.
    """

    table_2: Regression | None
    table_3: Regression | None
    table_4: Regression | None
    confusion: pd.DataFrame
    preferences: pd.DataFrame
    limits: tuple[str, ...]


def paper_tables(
    validation: pd.DataFrame,
    sets: pd.DataFrame | None = None,
    *,
    responses: Sequence[str] = RESPONSES,
    goal: str | None = None,
    level: float = 0.95,
) -> PaperTables:
    """Compute all statistics of the paper's validation sessions, for one material.

    `goal`: the response that the study searches for, by default the last; table III orders the others by the number of
    categories between them and the goal.

    `sets` is a sets table (`tables.validation.sets_frame`); its column `role`, if it has one, names the best, mid and
    worst sets. Without it roles are taken from the names, as plans give them: "best", "foam best", "foam P07 best"; and
    in table IV "aggregate" and "individual:PARTICIPANT", optionally after a material.

    A table that the data do not allow is None, and the last field has a sentence on it. Raises `InputError` for an
    invalid validation table, several materials, and a `level` that is not between 0 and 1.
    """
    check_level(level)
    table = of_material(check_validation(validation, responses), None)
    sources, roles = set_sources(table, sets)
    staged = table.assign(set_a=table["set_a"].map(roles), set_b=table["set_b"].map(roles))
    staged["preferred"] = [roles.get(name, name) for name in table["preferred"]]
    staged = staged[staged["set_a"].isin(ROLES) & staged["set_b"].isin(ROLES) & (staged["set_a"] != staged["set_b"])]
    answers, tables, limits = classifications(staged, responses), [], []
    place = len(responses) - 1 if goal is None else responses.index(goal)
    makers = {
        "II": lambda: _table_2(answers, responses[place], level),
        "III": lambda: _table_3(answers, responses, place, level),
        "IV": lambda: _table_4(table, sources, roles, level),
    }
    for number, make in makers.items():
        try:
            tables.append(make())
        except InputError as error:
            tables.append(None)
            limits.append(f"Table {number} is missing: {error}")
    rates = preference_rates(staged, ROLES, level=level)
    table_2, table_3, table_4 = tables
    return PaperTables(table_2, table_3, table_4, confusion(staged, responses, ROLES), rates, tuple(limits))


def set_sources(table: pd.DataFrame, sets: pd.DataFrame | None) -> tuple[dict[str, str], dict[str, str]]:
    """Source and role of every set of a validation table, as two dicts by set name, from the sets table.

    Without one, the last word of the name is both the source and, if it is best, mid or worst, the role; otherwise the
    role is the whole name. Raises `InputError` for a set that is missing from the sets table.
    """
    used = sorted({*table["set_a"], *table["set_b"]})
    if sets is None:
        return {name: name.rpartition(" ")[2] for name in used}, {name: role_of(name) or name for name in used}
    unknown = [name for name in used if name not in sets.index]
    if unknown:
        raise InputError(f'set "{unknown[0]}" of the validation table is not in the sets table; add it there.')
    roles = sets["role"] if "role" in sets else pd.Series([role_of(str(n)) or str(n) for n in sets.index], sets.index)
    return {name: str(sets.at[name, "source"]) for name in used}, {name: str(roles[name]) for name in used}


def _table_2(answers: pd.DataFrame, goal: str, level: float) -> Regression:
    """Table II: logit of the goal on whether the set was best. Raises InputError if no best set was
    classified."""
    _need(answers, ("best",))
    close = (answers["class"] == goal).astype(int)
    best = {"Best": (answers["set"] == "best").astype(float)}
    return binary_logit(close, best, answers[["participant"]], level=level)


def _table_3(answers: pd.DataFrame, responses: Sequence[str], goal: int, level: float) -> Regression:
    """Table III: ordered logit of the class, from the one with the index `goal`, on best and worst. Raises InputError
    if best, mid or worst was never classified."""
    _need(answers, ROLES)
    shifts = {name.capitalize(): (answers["set"] == name).astype(float) for name in ("best", "worst")}
    far = [abs(place - goal) for place in range(len(responses))]
    ranks = (answers["category"] - goal).abs()
    names = [" or ".join(r for r, at in zip(responses, far, strict=True) if at == rank) for rank in range(max(far) + 1)]
    return ordered_logit(ranks, shifts, answers[["participant"]], categories=names, level=level)


def _table_4(table: pd.DataFrame, sources: Mapping[str, str], roles: Mapping[str, str], level: float) -> Regression:
    """Table IV: logit of preferring the aggregate's set to an individual's; with ties the model for ties. Raises
    InputError without such comparisons."""
    rows = aggregate_comparisons(table, sources, roles)
    if rows.empty:
        raise InputError("no comparison of an aggregate's set with an individual's has a preference.")
    clusters, preferred = rows[["participant", "set"]], rows["preferred"].to_numpy()
    if (preferred != TIE).all():
        return binary_logit(preferred == _OURS, None, clusters, intercept=_OURS, level=level)
    one, other = np.full(len(rows), _OURS), np.full(len(rows), _THEIRS)
    return tied_preferences(one, other, preferred, clusters, reference=_THEIRS, level=level)


def aggregate_comparisons(
    table: pd.DataFrame, sources: Mapping[str, str], roles: Mapping[str, str] = MappingProxyType({})
) -> pd.DataFrame:
    """Preferences between an aggregate's set and an individual's best set.

    Columns `participant`, `set` (the individual's) and `preferred` ("Aggregate-Best", "individual" or "tie"). `sources`
    and `roles`: of each set, as in a sets table; comparisons with mid or worst sets, such as catch trials, are
    excluded.
    """
    left, right = (table[side].map(lambda name: source_kind(sources[name])) for side in ("set_a", "set_b"))
    mixed = ((left == "aggregate") & (right == "individual")) | ((left == "individual") & (right == "aggregate"))
    best = [~table[side].map(lambda name: roles.get(name, "")).isin(ROLES[1:]) for side in ("set_a", "set_b")]
    keep = mixed & best[0] & best[1] & (table["preferred"] != NONE)
    rows, first = table[keep], (left[keep] == "aggregate").to_numpy()
    ours, theirs = (np.where(first == swap, rows["set_a"], rows["set_b"]) for swap in (True, False))
    preferred = rows["preferred"].to_numpy()
    words = np.where(preferred == ours, _OURS, np.where(preferred == TIE, TIE, _THEIRS))
    return pd.DataFrame({"participant": rows["participant"].to_numpy(), "set": theirs, "preferred": words})


def _need(answers: pd.DataFrame, roles: Sequence[str]) -> None:
    """Raise `InputError` unless sets of all these roles were classified."""
    absent = [name for name in roles if name not in set(answers["set"])]
    if absent:
        raise InputError(f'no comparison classifies the set "{absent[0]}".')
