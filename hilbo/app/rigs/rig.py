"""Interface of the backends that present stimuli to a participant: a haptic device (`device_rig`), or a program or
person with a link (`stimulus_rig`).

A rig knows nothing of answers. It prepares a rendering, shows it, rests, stops; its state is a `Snapshot`, and it
reports each new one. The runner leads a trial through any of them in the same way.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

from hilbo.study.file.protocols import Show

__all__ = ["Loaded", "MissedError", "Notice", "Rig", "Showing", "Snapshot"]


class Snapshot(NamedTuple):
    """The last known state of a rig.

    `state`: RUNNING, STOPPED, HOLD, ESTOP, LOST, or WAITING before the first program or person has joined. `contact`:
    something touches it. `lost`: why it is not available, None while it is. `reason`: why it is in HOLD or ESTOP.
    `facts`: what the log gets of it. `rows`: what the experimenter sees of it, names and values. `excused`: its state
    comes from a time without a server, so that it voids no trial.
    """

    state: str
    contact: bool
    lost: str | None
    reason: str = ""
    facts: Mapping[str, Any] = {}
    rows: tuple[tuple[str, str], ...] = ()
    excused: bool = False


class Notice(NamedTuple):
    """A sentence that a device sent unasked, without a full stop, and when it arrived, s since the epoch."""

    time: float
    text: str


class Showing(NamedTuple):
    """A request to show a step of a trial. `presentation`: how often the trial has begun; `values`: parameters of a
    rendering in physical units; None for the reference and a neutral interval."""

    trial: int
    presentation: int
    step: int
    show: Show
    values: Mapping[str, float] | None
    material: str | None


class Loaded(NamedTuple):
    """An active stimulus: its facts for the log, and how long (s) the rig took, without the wait for a hand."""

    facts: dict[str, Any]
    took_s: float


class MissedError(RuntimeError):
    """The requested stimulus was not presented: the trial is void."""


@runtime_checkable
class Rig(Protocol):
    """Backend that presents stimuli. `notes`: messages for the person who started it. `simulated`: nothing moves. Every
    failure is a RuntimeError with a sentence."""

    title: str
    simulated: bool
    notes: list[str]
    snapshot: Snapshot

    @property
    def words(self) -> str:
        """What it is, in words, for the experimenter."""
        ...

    async def prepare(self, showing: Showing) -> Loaded | None:
        """Prepare a rendering while something else is presented. `Loaded` if it is then active; None if it comes in
        force with `show`. A rig that touches the hand waits here, and in `show`, until the hand has left."""
        ...

    async def show(self, showing: Showing) -> Loaded | None:
        """Present a step from now on; returns once it is presented, with `Loaded` if that activated a stimulus.
        Raises `MissedError`."""
        ...

    def telemetry(self, trial: int, presentation: int) -> Mapping[str, int] | None:
        """Counts of the samples since this presentation of a trial began: `samples`, and for each flag of
        `hilbo.study.file.trial_flags` that occurred the samples with it. None where no telemetry was recorded."""
        ...

    async def blank(self) -> None:
        """End the presentation of a trial, after its last step."""
        ...

    async def rest(self) -> None:
        """Present nothing from now on."""
        ...

    async def estop(self) -> None:
        """Stop at once, before all other requests; returns once that is acknowledged."""
        ...

    async def clear(self) -> None:
        """Leave HOLD or ESTOP."""
        ...

    def hang_up(self) -> None:
        """Answer all waiting requests, since the server ends."""
        ...

    def close(self) -> None:
        """Stop, and release the device."""
        ...
