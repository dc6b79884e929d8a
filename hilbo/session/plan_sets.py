"""The sets of a validation, from the results of an optimisation and the answers that these were made of.

The map is fitted again from the answers, so that best, mid and worst are read from the very map, and must have its
optimum where result.json has it: results of other answers, or of another study, are refused.
"""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hilbo.errors import InputError
from hilbo.search.candidates import search_points
from hilbo.session.plan import Source
from hilbo.study.aggregate import aggregate_cohort
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.map_summary import best_mid_worst

__all__ = ["aggregate_best_sets", "check_participants", "read_result", "validation_sets"]

_SAME = 1e-6  # of the search ranges
_NAMES = ("best", "mid", "worst")
NamedSets = dict[str, dict[str, float]]


def read_result(path: str | os.PathLike, study: Study) -> dict[str, Any]:
    """A result.json of this study. Raises InputError."""
    try:
        found = json.loads(Path(path).read_text(encoding="utf-8"))
        whole = "parameters" in found["optimum"] and all("participant" in row for row in found["participants"])
        same = found["study"] == study.hash
        if not whole:
            raise KeyError("parameters")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(f"{path}: is no result.json of hilbo; give the one that hilbo aggregate wrote.") from error
    if not same:
        raise InputError(
            f"{path}: is the result of another study ({found['study']}, not {study.hash}); aggregate the answers again"
            " with this study file."
        )
    return found


def check_participants(result: dict[str, Any], participants: Sequence[str], source: Source) -> None:
    """Validation of the aggregate needs people who are not in it, of individuals' own maps these very people."""
    known = {row["participant"] for row in result["participants"]}
    for person in participants:
        if source == "aggregate" and person in known:
            raise InputError(
                f'plan: participant "{person}" is in the map that is to be validated; invite people who are not.'
            )
        if source == "individual" and person not in known:
            raise InputError(
                f'plan: participant "{person}" has no map of their own in the results; plan for those who do.'
            )


def validation_sets(
    study: Study, result: dict[str, Any], cohort: Cohort, source: Source, participants: Sequence[str]
) -> NamedSets:
    """Best, mid and worst of the map, or of each participant's own (`PARTICIPANT best`): name -> parameters."""
    seed = int(result.get("seed", 0))
    found = aggregate_cohort(study, cohort, seed, alternatives=False)
    _check_same(study, result, np.asarray(found.optimum.x))
    points = search_points(study.space, seed)
    if source == "aggregate":
        return _named(study, best_mid_worst(study, found.surface, points, prior=found.map.map_prior).x, "")
    sets: NamedSets = {}
    for person in participants:
        row = cohort.names.index(person)
        own = jax.tree.map(lambda leaf, row=row: leaf[row], found.posteriors)
        sets |= _named(study, best_mid_worst(study, _Predict(own), points).x, f"{person} ")
    return sets


class _Predict(eqx.Module):
    posterior: Any

    def __call__(self, x):
        return self.posterior.predict(x)


def aggregate_best_sets(study: Study, result: dict[str, Any]) -> NamedSets:
    """The population's optimum and every individual's own."""

    def of(optimum):
        return {name: float(optimum["parameters"][name]) for name in study.space.names}

    sets = {"aggregate": of(result["optimum"])}
    for row in result["participants"]:
        if "optimum" not in row:
            raise InputError("plan: the results hold no individuals' optima; aggregate again without --no-individuals.")
        sets[f"individual:{row['participant']}"] = of(row["optimum"])
    return sets


def _named(study, unit, prefix) -> NamedSets:
    physical = np.asarray(study.space.to_physical(jnp.asarray(unit))).tolist()
    return {
        prefix + name: dict(zip(study.space.names, row, strict=True))
        for name, row in zip(_NAMES, physical, strict=True)
    }


def _check_same(study, result, x):
    values = [result["optimum"]["parameters"][name] for name in study.space.names]
    apart = np.max(np.abs(np.asarray(study.space.to_unit(np.array(values))) - x))
    if apart > _SAME:
        raise InputError(
            f"plan: the optimum of these answers is {apart:.2g} of the ranges away from that of result.json; give the"
            " trials that it was made from."
        )
