"""Sessions of a study by their phases: how many, of how many participants, and how long they took; and who took part,
without a row of anybody."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from hilbo.study.formats.json_file import Content
from hilbo.study.tables.sessions import SessionRow

__all__ = ["SESSIONS_HEAD", "described", "session_rows"]

SESSIONS_HEAD = ("sessions", "number", "participants", "minutes, median (shortest to longest)")


def session_rows(held: Sequence[SessionRow]) -> list[list[str]]:
    """Rows of the page's table, as texts, one for each combination of phases. Durations are from the first to the last
    event, breaks included, and "–" without events."""
    kinds: dict[str, list[SessionRow]] = {}
    for session in held:
        kinds.setdefault(session.phases, []).append(session)
    return [
        [phases, str(len(those)), str(len({session.participant for session in those})), _minutes(those)]
        for phases, those in kinds.items()
    ]


def described(people: Mapping[str, Mapping[str, str]], names: Sequence[str]) -> Content:
    """Ages and handedness of the participants `names`: `participants` (number), `mean_age` (years, None if unknown) and
    `handedness` (counts) for result.json, and `words` for the page. `people`: participant -> row of participants.csv;
    rows of others are not considered, nor cells that are empty."""
    rows = [people[name] for name in names if name in people]
    ages = [int(row["age"]) for row in rows if row.get("age")]
    hands = Counter(row["handedness"] for row in rows if row.get("handedness"))
    about = f"{len(names)} participant{'' if len(names) == 1 else 's'}"
    parts = []
    if ages:
        spread = f" ± {np.std(ages, ddof=1):.1f}" if len(ages) > 1 else ""
        parts.append(f"age {np.mean(ages):.1f}{spread} years ({min(ages)} to {max(ages)}; known of {len(ages)})")
    if hands:
        each = ", ".join(f"{hand} {count}" for hand, count in hands.most_common())
        parts.append(f"handedness: {each} (known of {hands.total()})")
    words = f"{about}: {'; '.join(parts)}." if parts else f"{about}; their ages and handedness are not known."
    return {
        "participants": len(names),
        "mean_age": float(np.mean(ages)) if ages else None,
        "handedness": dict(hands),
        "words": words,
    }


def _minutes(held: Sequence[SessionRow]) -> str:
    """Median, smallest and largest duration in minutes, as text; "–" without sessions that have both times."""
    times = [(s.ended_at - s.began_at) / 60 for s in held if s.began_at is not None and s.ended_at is not None]
    if not times:
        return "–"
    return f"{np.median(times):.0f} ({min(times):.0f} to {max(times):.0f})"
