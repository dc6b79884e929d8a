"""How a study's answers depart from the plan that was made before them: people, answers, and the study file."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec

from hilbo.study.typed_files import decoded, read_bytes

__all__ = ["departures"]

_PHASE = "optimisation"


class _Row(msgspec.Struct):
    """A planned session."""

    participant: str


class _Plan(msgspec.Struct):
    """What is read of a plan."""

    study: str
    hash: str
    phase: str
    participants: Annotated[tuple[_Row, ...], msgspec.Meta(min_length=1)]


def departures(
    path: Path, study_hash: str, trials: int, counts: Mapping[str, Sequence[int]]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """What departs from the plan in a file, in sentences; and what is as planned, if nothing does.

    **Arguments:** `study_hash`: of the study file of these answers; `trials`: that each person was to answer for each
    material; `counts`: person -> number of answers for each material. Raises InputError for a file that is no plan.
    """
    plan = decoded(read_bytes(path), _Plan, str(path), "is no plan; make one with hilbo plan")
    if plan.phase != _PHASE:
        return (f"{path.name} is a plan of {plan.phase}, so that these answers are compared with no plan.",), ()
    planned = [row.participant for row in plan.participants]
    sentences = []
    if plan.study != study_hash:
        sentences.append(f"The study file is not the one that was planned with ({study_hash}, planned {plan.study}).")
    absent = [name for name in planned if name not in counts]
    if absent:
        sentences.append(f"Planned, and without answers here: {', '.join(absent)} ({len(absent)} of {len(planned)}).")
    others = [name for name in counts if name not in planned]
    if others:
        sentences.append(f"Not in the plan, and with answers here: {', '.join(others)}.")
    other = [f"{name} ({', '.join(map(str, n))})" for name, n in counts.items() if any(k != trials for k in n)]
    if other:
        sentences.append(f"Another number of answers than the planned {trials}: {', '.join(other)}.")
    if not sentences:
        return (), (f"Nothing departs from the plan {plan.hash}: {len(planned)} participants, {trials} answers each.",)
    return tuple(f"Departs from the plan {plan.hash}. {sentence}" for sentence in sentences), ()
