"""What shows renderings to a participant, whatever it is: a device of ours (`device_rig`), or a program with a link of
its own (`stimulus_rig`).

A rig knows nothing of answers. It makes a rendering ready, shows it, rests, stops; what it says of itself is a
`Snapshot`, and it tells of each new one. The runner leads a trial through either in the same way.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

from hilbo.study.file.protocols import Show

__all__ = ["Loaded", "MissedError", "Rig", "Showing", "Snapshot"]


class Snapshot(NamedTuple):
    """What was last seen of a rig.

    `state`: RUNNING, STOPPED, HOLD, ESTOP or LOST. `lost`: why there is none, None while there is one. `reason`: why it
    holds. `facts`: what of it goes into the log. `rows`: what the experimenter sees of it, names and values. `excused`:
    it is as it is because no server spoke to it, which is no fault of the trial that was begun.
    """

    state: str
    contact: bool
    lost: str | None
    reason: str = ""
    facts: Mapping[str, Any] = {}
    rows: tuple[tuple[str, str], ...] = ()
    excused: bool = False


class Showing(NamedTuple):
    """What is shown in a step of a trial. `values`: of a rendering, parameters in physical units; None for the
    reference and for a neutral interval."""

    trial: int
    presentation: int
    step: int
    show: Show
    values: Mapping[str, float] | None
    material: str | None


class Loaded(NamedTuple):
    """A rendering in force: what the log holds of that, and how long (s) the rig took, without the wait for a hand."""

    facts: dict[str, Any]
    took_s: float


class MissedError(RuntimeError):
    """What was asked for was not presented: the trial is void."""


@runtime_checkable
class Rig(Protocol):
    """What shows renderings. `notes`: what to tell whoever started it. `simulated`: nothing moves. Whatever fails is a
    RuntimeError with a sentence."""

    title: str
    simulated: bool
    notes: list[str]
    snapshot: Snapshot

    @property
    def words(self) -> str:
        """What it is, for the experimenter."""
        ...

    async def prepare(self, showing: Showing) -> Loaded | None:
        """Make a rendering ready while something else is shown. `Loaded` if it is in force by that; None if it will be
        when it is shown. A rig that touches the hand waits here, and in `show`, until the hand has left."""
        ...

    async def show(self, showing: Showing) -> Loaded | None:
        """Show it from now on; returns once it is shown. Raises `MissedError`."""
        ...

    def telemetry(self, trial: int, presentation: int) -> Mapping[str, int] | None:
        """Counts of the samples since this presentation of a trial began: `samples`, and those with a flag of
        `hilbo.study.file.trial_flags` by its name, where there are any. None where no telemetry was recorded."""
        ...

    async def blank(self) -> None:
        """End the presentation of a trial, after its last step."""
        ...

    async def rest(self) -> None:
        """Present nothing from now on."""
        ...

    async def estop(self) -> None:
        """Stop at once, overtaking everything; returns once that is acknowledged."""
        ...

    async def clear(self) -> None:
        """Leave a hold or a stop."""
        ...

    def hang_up(self) -> None:
        """Answer all waiting requests, since the server ends."""
        ...

    def close(self) -> None:
        """Stop, and let go."""
        ...
