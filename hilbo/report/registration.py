"""Page for the pre-registration of a planned study, in Markdown, from plan and study file.

What no file states, such as the reason for the number of participants and the expectations, is left as a line to fill
in.
"""

from collections.abc import Sequence
from typing import Any

from hilbo.likelihoods import Goal
from hilbo.population.rules.registry import RULES
from hilbo.report.page import text_of
from hilbo.study.file.plan_file import Plan
from hilbo.study.file.protocols import Protocol, protocol
from hilbo.study.file.reading import StudyFile

__all__ = ["registration", "selection_words"]

_ACQUISITIONS = {
    "ucb": "upper confidence bound",
    "log_ei": "log expected improvement",
    "thompson": "Thompson sampling",
    "top_category": "probability of the goal",
}


def registration(study: StudyFile, plan: Plan, version: str) -> str:
    """The page, in Markdown. `plan`: of this study, as `make_plan` gives it; `version`: hilbo's. Nothing is written."""
    goal = Goal.of(study.responses, study.goal)
    label = study.responses[goal.category]
    return text_of(
        "registration.md",
        study=study,
        plan=plan,
        version=version,
        protocols=_protocols(study, plan),
        groups=_groups(plan),
        warm_up=protocol(study.session, "warm-up").count,
        selection=selection_words(study.selection),
        rule=RULES[study.rule],
        optimum=RULES[study.rule].optimum_for(label, goal.is_highest),
        goal=goal.sentence(label) or f'The goal is the highest answer, "{label}".',
        model=_model(study),
    )


def _protocols(study: StudyFile, plan: Plan) -> list[tuple[str, Protocol]]:
    """The different protocols of the plan's phase, each with the names of its materials as a text; "" if all materials
    have the same."""
    names: dict[Protocol, list[str]] = {}
    for name in plan.materials:
        session = (study if name is None else study.material(name)).session
        names.setdefault(protocol(session, plan.phase), []).append(name or "")
    return [("" if len(names) == 1 else ", ".join(those), of) for of, those in names.items()]


def _groups(plan: Plan) -> dict[str, int]:
    """Material -> number of participants who have it, where they do not all have all; else {}."""
    have = [{block.material for block in row.header.blocks if block.phase == plan.phase} for row in plan.participants]
    if all(materials == set(plan.materials) for materials in have):
        return {}
    return {name: sum(name in materials for materials in have) for name in plan.materials if name is not None}


def selection_words(selection: Any) -> str:
    """How the trials of a session are chosen, as half a sentence. `selection`: table [selection] of a study file."""
    words = _ACQUISITIONS.get(selection.acquisition, selection.acquisition)
    weight = f", weight {selection.weight:g}" if selection.acquisition == "ucb" else ""
    return (
        f"{selection.space_filling} spread over the stimuli, the others chosen from the participant's own answers"
        f" ({words}{weight})"
    )


def _model(study: StudyFile) -> str:
    """Inference and the given hyperparameters of the [gp] table as text; "the rest learnt" if any of the four is not
    given. Correlations of categorical parameters are listed too.
    """
    gp = study.gp
    given = {
        "theta": gp.theta,
        "variance": gp.variance,
        "thresholds": gp.thresholds,
        "noise": gp.noise,
    }
    stated = [f"{name} {_value(value)}" for name, value in given.items() if value is not None]
    alike = [
        f"correlation {p.correlation:g} of any two levels of {p.name}" for p in study.space.parameters if p.categorical
    ]
    return ", ".join([f"inference {gp.inference}", *stated, *alike]) + (
        "" if len(stated) == len(given) else ", the rest learnt"
    )


def _value(value: float | Sequence[float]) -> str:
    """A number as text, or several as "(1, 2)"."""
    return f"{value:g}" if isinstance(value, int | float) else "(" + ", ".join(f"{v:g}" for v in value) + ")"
