"""Simulated validation sessions: participants who compare stimuli by their perceived dissimilarity.

New participants are drawn from the population of a simulated study. Given two stimuli, a participant perceives the
dissimilarity of each (`simulate.Person`) and prefers the smaller. Side by side, differences are exaggerated: the
population's `contrast` times the difference is added. Each is then put in the class whose criterion it stays below.
With probability `lapse` each of the three responses is a guess. As in the paper, every participant compares each pair
of best, mid and worst four times, and a few judges compare every individual's set with the aggregate's, twice.
"""

from itertools import combinations

import jax
import numpy as np
import pandas as pd
from jaxtyping import Float

from hilbo.search.rendering import Rendering
from hilbo.session.plan.set_codes import OWN, code_of
from hilbo.simulation.simulate import Person, Population, people
from hilbo.study.analysis.best_mid_worst import Sets
from hilbo.study.config import Study

__all__ = ["sets_table", "validation_table"]

_TIMES = 4  # that a participant compares a pair of best, mid and worst
_TWICE = 2  # that a judge compares an individual's set with the aggregate's


def sets_table(study: Study, sets: Sets, individuals: Float[np.ndarray, "M d"]) -> pd.DataFrame:
    """Sets table with best, mid and worst of the aggregate map, and all individual sets under anonymous codes, as in a
    plan.

    The aggregate's own set is "best". `individuals` (M, d) in the unit cube.
    """
    rows = [
        {"set_id": role, "source": "aggregate", "role": role} | Rendering.at(study.space, x).shown
        for role, x in zip(("best", "mid", "worst"), np.asarray(sets.x), strict=True)
    ]
    own: dict[str, dict[str, float]] = {}
    for x in individuals:
        values = Rendering.at(study.space, x).shown
        own[code_of(sorted(values.items()), own)] = values
    rows += [{"set_id": f"own-{code}", "source": OWN + code, "role": ""} | own[code] for code in sorted(own)]
    table = pd.DataFrame(rows)
    mechanics = study.space.mechanics
    return table if mechanics is None else table.assign(N=mechanics.N, T=mechanics.T)


def validation_table(
    study: Study, population: Population, table: pd.DataFrame, *, participants: int = 20, judges: int = 8, seed: int = 0
) -> pd.DataFrame:
    """Simulate a validation table over the sets of `sets_table`: new participants N01, … compare best, mid and worst,
    and judges J01, … compare "best" with each individual set, each in a random order."""
    rng = np.random.default_rng([seed, 1])
    crowd = people(study, population, participants + judges, seed + 7_919)
    x = {row["set_id"]: _unit(study, row) for _, row in table.iterrows()}
    individual_sets = [
        name for name, source in zip(table["set_id"], table["source"], strict=True) if source != "aggregate"
    ]
    pairs = [list(combinations(("best", "mid", "worst"), 2)) * _TIMES] * participants
    pairs += [[("best", name) for name in individual_sets] * _TWICE] * judges
    rows = []
    for person, asked in enumerate(pairs):
        model = person < participants
        name = f"{'N' if model else 'J'}{person + 1 if model else person + 1 - participants:02d}"
        for trial, i in enumerate(rng.permutation(len(asked))):
            a, b = asked[i] if rng.random() < 0.5 else asked[i][::-1]
            classes, preferred = _answer(study, crowd, person, x[a], x[b], population.contrast, rng)
            first = {"participant": name, "session": "model" if model else "aggregate-best", "trial": trial + 1}
            shown = {"class_a": classes[0], "class_b": classes[1]} if model else {"class_a": "", "class_b": ""}
            rows.append(first | {"set_a": a, "set_b": b, "first": "a"} | shown | {"preferred": (a, b)[preferred]})
    return pd.DataFrame(rows)


def _unit(study: Study, row: pd.Series) -> Float[np.ndarray, " d"]:
    """Point of the unit cube of a row of a sets table."""
    return np.asarray(study.space.to_unit(np.array([p.number(row[p.name]) for p in study.space.parameters])))


def _answer(
    study: Study,
    crowd: Person,
    person: int,
    x: Float[np.ndarray, " d"],
    y: Float[np.ndarray, " d"],
    contrast: float,
    rng: np.random.Generator,
) -> tuple[list[str], int]:
    """Simulate a comparison of the stimuli x and y (d,) by one participant of `crowd`: labels of both classes, and the
    preferred one (0: x, 1: y). `contrast`: fraction of their difference by which each is judged further from the other.
    """
    one = jax.tree.map(lambda leaf: np.asarray(leaf[person]), crowd)
    felt = np.array([one.perceived(point) for point in (x, y)])
    felt = felt + float(crowd.noise[person]) * rng.standard_normal(2)
    shown = felt + contrast * (felt - felt[::-1])
    judged = [int((value < np.asarray(crowd.criteria[person])).sum()) for value in shown]
    lapses = rng.random(3) < float(crowd.lapse[person])
    judged = [rng.integers(len(study.responses)) if lapse else c for c, lapse in zip(judged, lapses, strict=False)]
    preferred = (
        int(rng.integers(2))
        if lapses[2]
        else int(np.argmin(np.abs(felt) if study.goal.is_between else one.direction * felt))
    )
    return [study.responses[c] for c in judged], preferred
