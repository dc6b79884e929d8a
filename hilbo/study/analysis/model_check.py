"""Model check: cross-validated predictions of left-out participants, compared with their responses.

Every participant is left out once, alone or in a group if there are many or folds are slow, and predicted from the
others' responses and, response by response, from their own earlier ones: a session chooses stimuli by these, so that
without them a model that fits would seem not to. The hyperparameters are kept. Compared are the proportions of the
responses (overall, per participant, and per third of a session), the test-retest agreement at repeated stimuli, and the
predictive density with that of two baselines without a map, fitted to the others' responses
(`hilbo.population.judged.baselines`). A misfit is named at a level of 5 % for all comparisons together (Bonferroni): a
difference exceeds the normal quantile of the error that the predicted probabilities imply, and the t quantile, with one
degree of freedom less than participants, of the error that is clustered by participant.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri, stdtrit

from hilbo.population.judged.baselines import constant, quadratic
from hilbo.population.judged.leave_one_out import LeftOut, clustered, leave_one_out
from hilbo.population.judged.left_out_kept import leave_one_out_kept
from hilbo.population.rules.registry import RULES
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate, SayCount, silent
from hilbo.study.formats.json_file import Content

__all__ = ["check_sentences", "model_check"]

_FOLDS, _DEAR_FOLDS = 24, 6  # at most; the latter where each is a fit of all answers
_FALSE, _WORTH = 0.05, 0.05  # probability of naming a misfit where there is none; smallest difference of shares
_BASELINES = {"constant": "the same shares everywhere", "quadratic": "a quadratic ordinal probit of all answers"}
_GROUPS = 12  # of people, in which the baselines leave them out


def model_check(study: Study, aggregate: Aggregate, say: SayCount = silent) -> Content | None:
    """Results of the model check by cross-validation, as a dict for result.json; None for fewer than three participants
    with responses. `say`: progress.

    Keys: "hyperparameters" (specified or learnt), "shares" of the responses, also "by_third" of a session and
    "by_person", "repeats" (test-retest agreement), "not_converged" and "negative_log_density".
    """
    cohort = aggregate.cohort
    answered = np.flatnonzero(cohort.counts() > 0)
    if len(answered) < 3:
        return None
    left = _left_out(study, aggregate, answered, say)
    names, trials = cohort.names, cohort.trials
    mask = np.asarray(trials.mask)
    order = np.concatenate([np.flatnonzero(mask[p]) * 3 // mask[p].sum() for p in _people(left)])
    x = np.concatenate([np.asarray(trials.x)[p][mask[p]] for p in _people(left)])
    places = x
    if aggregate.map.effects is not None:
        context = np.concatenate([np.asarray(trials.context)[p][mask[p]] for p in _people(left)])
        places = np.concatenate([x, context[:, None]], axis=1)
    chosen = (left.q[:, None] == np.arange(len(study.responses))[None, :]).astype(float)
    content: Content = {
        "hyperparameters": "as stated" if study.learnt is None else "learnt from all answers",
        "shares": _shares(study, left, chosen, np.ones(len(left.q), bool)),
        "by_third": [_shares(study, left, chosen, order == third) for third in range(3) if (order == third).any()],
        "by_person": {
            names[p]: {
                "given": dict(zip(study.responses, chosen[left.person == p].mean(axis=0).tolist(), strict=True)),
                "predicted": dict(
                    zip(study.responses, left.probabilities[left.person == p].mean(axis=0).tolist(), strict=True)
                ),
            }
            for p in _people(left)
        },
        "repeats": _repeats(left, places),
        "not_converged": left.not_converged,
    }
    return content | {"negative_log_density": _densities(left, x, len(study.responses))}


def check_sentences(content: Content | None) -> list[str]:
    """A list of at most one sentence, with all misfits; empty if there are none, or if nothing was checked (`content`
    None)."""
    if content is None:
        return []
    repeats = content["repeats"]
    limits = _limits(len(content["shares"]) + (repeats is not None) + len(_BASELINES), len(content["by_person"]))
    wrong = [
        f'the proportion of "{label}" is {_percent(row["given"])} and was predicted as {_percent(row["predicted"])}'
        for label, row in content["shares"].items()
        if _differs(row, limits)
    ]
    if repeats is not None and _differs(repeats, limits):
        wrong.append(
            f"test-retest agreement is {_percent(repeats['given'])} of {repeats['pairs']} pairs of repeated stimuli and"
            f" was predicted as {_percent(repeats['predicted'])}"
        )
    for name, words in _BASELINES.items():
        row = content["negative_log_density"][name]
        if row["difference"] < -limits.student * row["error"]:
            gain = f"{-row['difference']:.3f} ± {row['error']:.3f} nats per response"
            wrong.append(f"{words} would predict better ({gain})")
    if not wrong:
        return []
    by = "the study's hyperparameters" if content["hyperparameters"] == "as stated" else "the learnt hyperparameters"
    return [f"With {by} the model does not fit the responses of left-out participants: {'; '.join(wrong)}."]


class _Limits(NamedTuple):
    """Quantiles of simultaneous comparisons, in errors: of a normal distribution, and of Student's t."""

    normal: float
    student: float


def _limits(comparisons: int, people: int) -> _Limits:
    """Limits for this number of two-sided comparisons at a common level of 5 %; `people`: number of clusters."""
    tail = _FALSE / (2 * comparisons)
    return _Limits(float(-ndtri(tail)), float(-stdtrit(people - 1, tail)))


def _percent(share: float) -> str:
    """A fraction as text in whole percent."""
    return f"{100 * share:.0f} %"


def _left_out(study: Study, aggregate: Aggregate, answered: np.ndarray, say: SayCount) -> LeftOut:
    """Cross-validated predictions, each participant left out alone, or in at most 24 groups (6 for slow methods).
    `answered`: rows of participants with responses."""
    trials = aggregate.cohort.trials
    cheap = RULES[study.rule].learns or aggregate.map.method == "by points"
    folds = min(_FOLDS if cheap else _DEAR_FOLDS, len(answered))
    groups = [answered[k::folds] for k in range(folds)]
    if study.learnt is not None:
        return leave_one_out_kept(study.learnt, trials, groups, partial(say, "predictions of left-out participants"))
    share = aggregate.map.share if RULES[study.rule].learns_share else None
    return leave_one_out(
        study.gp,
        trials,
        study.rule,
        share=share,
        posteriors=aggregate.posteriors,
        inference=study.inference,
        groups=groups,
    )[0]


def _people(left: LeftOut) -> list[int]:
    """Rows of the participants in the cohort, in the order of the predictions."""
    return list(dict.fromkeys(left.person.tolist()))


def _shares(study: Study, left: LeftOut, chosen: Float[np.ndarray, "n C"], rows: np.ndarray) -> Content:
    """For each response its observed and predicted proportion and the error of the difference, over the selected
    `rows`. `chosen`: one-hot responses."""
    return {
        label: _compared(chosen[rows, c], left.probabilities[rows, c], left.person[rows])
        for c, label in enumerate(study.responses)
    }


def _compared(
    given: Float[np.ndarray, " n"], predicted: Float[np.ndarray, " n"], person: np.ndarray
) -> dict[str, float]:
    """Mean of outcomes (0 or 1) and of their probabilities, as "given" and "predicted", with the standard errors of the
    difference: "clustered" by participant, "implied" by the probabilities, and "error", the larger of the two, because
    few equal responses make the former too small."""
    _, error = clustered(given - predicted, person)
    implied = float(np.sqrt(np.sum(predicted * (1.0 - predicted)))) / len(given)
    means = {"given": float(given.mean()), "predicted": float(predicted.mean())}
    return means | {"error": float(np.fmax(error, implied)), "clustered": float(error), "implied": implied}


def _differs(row: Content, limits: _Limits) -> bool:
    """Whether observed and predicted differ by more than 0.05 and by more than both errors allow."""
    gap = abs(row["given"] - row["predicted"])
    return gap > max(_WORTH, limits.normal * row["implied"], limits.student * row["clustered"])


def _repeats(left: LeftOut, x: Float[np.ndarray, "n d"]) -> Content | None:
    """Test-retest agreement: number of pairs of consecutive responses of a participant to the same stimulus, and their
    observed and predicted agreement. None without pairs. `x`: stimuli, with the context of a random effect as a further
    column."""
    same, expected, person = [], [], []
    for p in _people(left):
        rows = np.flatnonzero(left.person == p)
        _, place = np.unique(x[rows], axis=0, return_inverse=True)
        order = np.argsort(place.ravel(), kind="stable")
        again = np.flatnonzero(np.diff(place.ravel()[order]) == 0)
        first, second = rows[order[again]], rows[order[again + 1]]
        same += (left.q[first] == left.q[second]).tolist()
        expected += left.probabilities[second, left.q[first]].tolist()
        person += [p] * len(again)
    if not same:
        return None
    return {"pairs": len(same)} | _compared(np.array(same, float), np.array(expected), np.array(person))


def _densities(left: LeftOut, x: Float[np.ndarray, "n d"], categories: int) -> Content:
    """Mean negative log density of the responses (nats per response): "map", and for each baseline "cost", "difference"
    from the map's and its standard "error". Baselines are fitted without the participant's group, of up to 12."""
    _, place = np.unique(left.person, return_inverse=True)
    groups = place % _GROUPS
    costs = {name: np.empty(len(left.q)) for name in _BASELINES}
    for group in np.unique(groups):
        out = groups == group
        predicted = {
            "constant": constant(left.q, categories, ~out, left.person),
            "quadratic": quadratic(x, left.q, categories, ~out, left.person),
        }
        for name, chances in predicted.items():
            costs[name][out] = -np.log(chances[out, left.q[out]])
    content: Content = {"map": float(left.cost.mean())}
    for name, cost in costs.items():
        difference, error = clustered(cost - left.cost, left.person)
        content[name] = {"cost": float(cost.mean()), "difference": difference, "error": error}
    return content
