"""False-positive rates of the verdicts on hypotheses, for differences between participants with expectation 0.

    python benchmarks/false_verdicts.py [--studies 20000] [--write]

Differences between participants are drawn with an expectation of 0: shares of the highest answer in the first and the
last 8 of 24 trials of people with constant shares, as in H1; and distances of optima, normal or log-normal, as in H2 to
H4. --write puts the table into docs/guides/report.md.
"""

import argparse

import numpy as np
from pages import put

from hilbo.report.study.hypotheses import _difference

PEOPLE, TRIALS = (3, 8, 24), 8


def shares(mean, spread):
    def draw(rng, people):
        each = np.clip(rng.normal(mean, spread, people), 0.01, 0.99)
        return 100 * (rng.binomial(TRIALS, each) - rng.binomial(TRIALS, each)) / TRIALS

    return draw


KINDS = {
    "shares, near 10 %": shares(0.1, 0.05),
    "shares, near 35 %": shares(0.35, 0.15),
    "distances, normal": lambda rng, people: rng.normal(0.0, 12.0, people),
    "distances, log-normal (sd 0.6)": lambda rng, people: rng.lognormal(3.0, 0.6, people) - np.exp(3.0 + 0.6**2 / 2),
}


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--studies", type=int, default=20_000)
    options.add_argument("--write", action="store_true")
    chosen = options.parse_args()
    text = "\n".join(table(chosen.studies))
    print(text)
    if chosen.write:
        put("guides/report.md", "false verdicts", text)


def table(studies):
    yield "| differences | participants | supports | contradicts |"
    yield "|---|---:|---:|---:|"
    for kind, (name, draw) in enumerate(KINDS.items()):
        for people in PEOPLE:
            rng = np.random.default_rng([people, kind])
            sides = [_difference(draw(rng, people)).side for _ in range(studies)]
            rates = (f"{100 * sides.count(side) / studies:.1f} %" for side in ("supports", "contradicts"))
            yield f"| {name} | {people} | {' | '.join(rates)} |"


if __name__ == "__main__":
    main()
