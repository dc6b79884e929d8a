"""A planned study as one page for a pre-registration: what was fixed before the first answer, from plan and study file.

The page is Markdown, which registries take as it is. What no file says (why so many people, what is expected) stands
there as a line to fill in, so that nobody takes its silence for a decision.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from hilbo.population.rules.registry import RULES
from hilbo.study.file.plan_file import Plan
from hilbo.study.file.protocols import Phase, protocol
from hilbo.study.file.reading import StudyFile

__all__ = ["registration", "selection_words"]

_OPEN = "**To be written by you.**"
_ACQUISITIONS = {
    "ucb": "upper confidence bound",
    "log_ei": "log expected improvement",
    "thompson": "Thompson sampling",
    "top_category": "probability of the highest answer",
    "mean": "largest posterior mean",
}


def registration(study: StudyFile, plan: Plan, version: str) -> str:
    """The page, in Markdown. `plan`: of this study, as `make_plan` gives it; `version`: hilbo's."""
    phase: Phase = plan.phase
    parts = [
        (f"{study.name}: what is fixed before the first answer", _identity(study, plan, version)),
        ("Question and expectation", [f"{_OPEN} What is asked, and what is expected."]),
        ("Participants", _participants(plan)),
        ("Stimuli", _stimuli(study)),
        ("Trials", _trials(study, phase)),
        ("Exclusion", _exclusion(study)),
        ("Analysis", _analysis(study) if phase == "optimisation" else _validation_analysis()),
        ("After registration", ["Whatever departs from this page is reported, with its reason."]),
    ]
    sections = ["\n".join([f"{'#' if i == 0 else '##'} {head}", "", *lines]) for i, (head, lines) in enumerate(parts)]
    return "\n\n".join(sections) + "\n"


def _identity(study: StudyFile, plan: Plan, version: str) -> list[str]:
    return [
        f"* Sessions: {plan.phase}",
        f"* Study file: {study.source.rsplit('/', 1)[-1]}, hash {study.hash}",
        f"* Plan: hash {plan.hash}, random seed {plan.seed}; both hashes stand in every session's log",
        f"* Software: hilbo {version}",
    ]


def _participants(plan: Plan) -> list[str]:
    people = [row.participant for row in plan.participants]
    lines = [
        f"* {len(people)}, {people[0]} to {people[-1]}. {_OPEN} Why so many (`hilbo power`), and who may take part.",
        f"* Data collection ends with the last of them. {_OPEN} Whether results are looked at before, and what for.",
        "* Who drops out may be replaced; the new participant has the same row of the plan (`hilbo plan --reissue`).",
    ]
    if len(plan.materials) > 1:
        balance = "complete" if plan.complete else f"exact at {plan.complete_at}"
        lines.append(f"* Materials {_list(plan.materials)}, in counterbalanced order ({balance}).")
    return lines


def _stimuli(study: StudyFile) -> list[str]:
    lines = ["| parameter | from | to | unit | scale |", "|---|---:|---:|---|---|"]
    for parameter in study.space.parameters:
        ends = f"{parameter.low:g} | {parameter.high:g}"
        if parameter.levels:
            lines.append(f"| {parameter.name} | {_list(parameter.levels)} | | | levels, without an order |")
            continue
        whole = ", whole numbers" if parameter.integer else ""
        lines.append(f"| {parameter.name} | {ends} | {parameter.unit} | {parameter.scale}{whole} |")
    bounds = [f"Nothing is presented but what keeps {constraint.words}." for constraint in study.space.constraints]
    return [*lines, "", *bounds, _presenting(study)]


def _presenting(study: StudyFile) -> str:
    if study.stimulus is None:
        return "Only renderings that are passive on the device are presented."
    who = "A program" if study.stimulus.by == "program" else "A person"
    return f"{who} presents them, and confirms what is in force; analyses use the confirmed values."


def _trials(study: StudyFile, phase: Phase) -> list[str]:
    shown = protocol(study.session, phase)
    steps = " then ".join(f"{step.show} {step.seconds:g} s" for step in shown.steps)
    lines = [f"* A trial: {steps}; then the question. Answers: {_list(study.responses)}."]
    warm = protocol(study.session, "warm-up").count
    lines.append(f"* Before them at least {warm} trials of warm-up, which do not count.")
    if phase == "optimisation":
        chosen = study.selection
        lines += [
            f"* {chosen.trials} trials that count for each participant and material: {selection_words(chosen)}.",
            f"* A session stops after {chosen.trials} answers, at no other result. A trial in which the presentation"
            " failed is void and comes again.",
        ]
    else:
        lines.append(f"* Each pair comes {shown.count} times; order and sides are in the plan.")
    return lines


def selection_words(selection: Any) -> str:
    """How the trials of a session are chosen, by the study file's table [selection]."""
    words = _ACQUISITIONS.get(selection.acquisition, selection.acquisition)
    weight = f", weight {selection.weight:g}" if selection.acquisition == "ucb" else ""
    return (
        f"{selection.space_filling} spread over the stimuli, the others chosen from the participant's own answers"
        f" ({words}{weight})"
    )


def _exclusion(study: StudyFile) -> list[str]:
    rule, flags = study.exclude, ", ".join(study.exclude_flags).replace("_", " ")
    trials = f"Trials with these device flags are excluded: {flags} (`[study] exclude_flags`)."
    if rule:
        people = f"Participants for whom `{rule}` holds are left out (`[study] exclude`)."
    else:
        people = "No participant is excluded because of their responses (`[study] exclude` is empty)."
    return [people, *([trials] if flags else [])]


def _analysis(study: StudyFile) -> list[str]:
    rule = RULES[study.rule]
    effect = study.random_effect
    return [
        f"* Population map: {rule.description} (`{rule.name}`), by hilbo's documentation of that version.",
        *([f"* Random effect of each `{effect}`, where a rule learns the hyperparameters."] if effect else []),
        f"* Model of one person: Gaussian process with an ordinal probit likelihood, {_model(study)}.",
        f"* Primary result: among the stimuli that may be presented {rule.sought}, with its predicted"
        " responses of a new participant.",
        "* Beside it: everybody's own maximum, alternative rules, sensitivity to the hyperparameters, predictive"
        " checks with each participant left out. They are secondary, and no rule is chosen by them.",
        f"* {_OPEN} Which hypotheses are tested, by which test, at which level.",
    ]


def _model(study: StudyFile) -> str:
    gp = study.gp
    given = {
        "theta": gp.theta,
        "variance": gp.variance,
        "thresholds": gp.thresholds,
        "noise": gp.noise,
    }
    stated = [f"{name} {_value(value)}" for name, value in given.items() if value is not None]
    alike = [f"correlation {p.correlation:g} of any two levels of {p.name}" for p in study.space.parameters if p.levels]
    return ", ".join([f"inference {gp.inference}", *stated, *alike]) + (
        "" if len(stated) == len(given) else ", the rest learnt"
    )


def _validation_analysis() -> list[str]:
    return [
        "* Classes of each set, and which of two is preferred: ordered and binary logits with errors clustered by"
        " participant, beside counts.",
        f"* {_OPEN} Which comparison is primary, by which test, at which level.",
    ]


def _value(value: float | Sequence[float]) -> str:
    return f"{value:g}" if isinstance(value, int | float) else "(" + ", ".join(f"{v:g}" for v in value) + ")"


def _list(names: Iterable[str | None]) -> str:
    return ", ".join(f'"{name}"' for name in names)
