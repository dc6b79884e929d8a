"""Page for the pre-registration of a planned study, in Markdown, from plan and study file.

What no file states, such as the reason for the number of participants and the expectations, is left as a line to fill
in.
"""

from collections.abc import Sequence
from typing import Any

from hilbo.population.rules.registry import RULES
from hilbo.report.page import text_of
from hilbo.study.file.plan_file import Plan
from hilbo.study.file.protocols import protocol
from hilbo.study.file.reading import StudyFile

__all__ = ["registration", "selection_words"]

_ACQUISITIONS = {
    "ucb": "upper confidence bound",
    "log_ei": "log expected improvement",
    "thompson": "Thompson sampling",
    "top_category": "probability of the highest answer",
}


def registration(study: StudyFile, plan: Plan, version: str) -> str:
    """The page, in Markdown. `plan`: of this study, as `make_plan` gives it; `version`: hilbo's. Nothing is written."""
    return text_of(
        "registration.md",
        study=study,
        plan=plan,
        version=version,
        trial=protocol(study.session, plan.phase),
        warm_up=protocol(study.session, "warm-up").count,
        selection=selection_words(study.selection),
        rule=RULES[study.rule],
        model=_model(study),
    )


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
    alike = [f"correlation {p.correlation:g} of any two levels of {p.name}" for p in study.space.parameters if p.levels]
    return ", ".join([f"inference {gp.inference}", *stated, *alike]) + (
        "" if len(stated) == len(given) else ", the rest learnt"
    )


def _value(value: float | Sequence[float]) -> str:
    """A number as text, or several as "(1, 2)"."""
    return f"{value:g}" if isinstance(value, int | float) else "(" + ", ".join(f"{v:g}" for v in value) + ")"
