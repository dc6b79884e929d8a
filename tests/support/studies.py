"""Small studies and their answers, which several test files share."""

from itertools import product

import numpy as np
import pandas as pd

from hilbo.study.cohort import cohort_of
from hilbo.study.config import Study

__all__ = [
    "BEST",
    "MID",
    "PEOPLE",
    "PLAIN",
    "SOUND",
    "STUDY",
    "TRIALS",
    "WORST",
    "answered",
    "paper_counts",
    "plain",
    "plain_study",
    "population_answers",
    "population_study",
]

BEST, MID, WORST = (147, 11, 2), (24, 114, 22), (0, 39, 121)  # close, similar, different


PLAIN = {
    "schema": 1,
    "study": {"name": "plain", "responses": ["different", "similar", "close"]},
    "parameters": {n: {"low": low, "high": high, "unit": ""} for n, low, high in (("u", 0.0, 1.0), ("v", 10.0, 20.0))},
    "gp": {"theta": 30.0, "variance": 1.0, "thresholds": [-0.5, 0.5], "noise": 0.5},
}


SOUND = """\
schema = 1
[study]
name = "sound"
responses = ["bad", "fair", "good"]
[parameters.level]
low = 0
high = 10
[parameters.tone]
low = -1
high = 1
[aggregation]
rule = "learnt-1"
"""  # nothing about hyperparameters: they are learnt


PEOPLE, TRIALS = 37, 6


def population_study(inference="laplace"):
    return Study.from_dict(
        {
            "schema": 1,
            "study": {"name": "plain", "responses": ["bad", "fair", "good"]},
            "parameters": {"gain": {"low": 1.0, "high": 9.0, "scale": "log"}, "delay": {"low": 0.0, "high": 5.0}},
            "gp": {"theta": 5.0, "variance": 1.3, "thresholds": [-0.5, 0.5], "noise": 0.5, "inference": inference},
            "selection": {"trials": TRIALS, "space_filling": 2},
        }
    )


STUDY = population_study()


def population_answers(people=PEOPLE, seed=0):
    """Everybody likes what is near a point of their own; not everybody gave all answers."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(size=(people, TRIALS, 2))
    apart = np.linalg.norm(x - rng.normal(0.45, 0.1, (people, 1, 2)), axis=2) + 0.1 * rng.normal(size=x.shape[:2])
    table = pd.DataFrame(np.asarray(STUDY.space.to_physical(x.reshape(-1, 2))), columns=["gain", "delay"])
    table["participant"] = np.repeat([f"P{j}" for j in range(people)], TRIALS)
    table["trial"] = np.tile(np.arange(1, TRIALS + 1), people)
    table["category"] = (apart < 0.45).astype(int).ravel() + (apart < 0.25).ravel()
    return table[(np.tile(np.arange(TRIALS), people) < 4) | (np.repeat(np.arange(people), TRIALS) % 3 > 0)]


def paper_counts(rng, ties=0):
    """A validation table with the paper's counts: 20 people for the sets, 8 people and 24 individuals for table IV."""
    words = ("close", "similar", "different")
    pools = {
        name: list(rng.permutation(np.repeat(words, counts)))
        for name, counts in (("best", BEST), ("mid", MID), ("worst", WORST))
    }
    losses = {("best", "mid"): 4, ("best", "worst"): 0, ("mid", "worst"): 8}
    lost = {pair: list(rng.permutation([1] * count + [0] * (80 - count))) for pair, count in losses.items()}
    rows = []
    for person, _, pair in product(range(20), range(4), losses):
        a, b = pair[:: rng.choice([-1, 1])]
        win = pair[lost[pair].pop()]
        rows.append((f"P{person}", "model", a, b, "a", pools[a].pop(), pools[b].pop(), win))
    ours = list(rng.permutation(["aggregate"] * 279 + ["individual"] * (105 - ties) + ["tie"] * ties))
    for person, item, _ in product(range(8), range(24), range(2)):
        win = {"individual": "b", "aggregate": "aggregate", "tie": "tie"}[ours.pop()]
        rows.append((f"V{person}", "aggregate-best", "aggregate", f"individual:{item}", "b", "", "", win))
    names = ["participant", "session", "set_a", "set_b", "first", "class_a", "class_b", "preferred"]
    table = pd.DataFrame(rows, columns=names).assign(material="foam")
    return table.assign(trial=table.groupby("participant").cumcount() + 1)


def plain():
    return Study.from_dict(PLAIN)


def plain_study(dim):
    """A box of `dim` parameters without mechanics, one of them logarithmic."""
    parameters = {f"p{i}": {"low": 1.0, "high": 10.0, "unit": "mm"} for i in range(dim)}
    parameters["p0"]["scale"] = "log"
    return Study.from_dict(
        {
            "schema": 1,
            "study": {"name": "<any & all>", "responses": ["bad", "good"]},
            "parameters": parameters,
            "gp": {"theta": 5.0, "variance": 1.0, "thresholds": [0.0], "noise": 0.5},
            "selection": {"trials": 6},
        }
    )


def answered(study, people=2, trials=6):
    """Everybody finds what is near the middle of the cube good."""
    x = np.random.default_rng(1).uniform(size=(people * trials, study.space.dim))
    table = pd.DataFrame(np.asarray(study.space.to_physical(x)), columns=list(study.space.names))
    table["participant"] = np.repeat([f"P{i}" for i in range(people)], trials)
    table["trial"] = np.tile(np.arange(1, trials + 1), people)
    table["response"] = np.array(study.responses)[(np.abs(x - 0.5).max(axis=1) < 0.3).astype(int)]
    return cohort_of(table, study)
