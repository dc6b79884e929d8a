"""A session being held, as its parts see it: what a `Hub` is for whoever leads, interrupts, commands or shows it.

The hub makes its parts, and they know no more of it than this: nothing but `commit` reaches the log.
"""

import asyncio
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from typing import Any, Protocol, runtime_checkable

from hilbo.app.rigs.rig import Rig
from hilbo.app.wire.security import Role
from hilbo.session.log.records import Event
from hilbo.session.log.state import LiveSession

__all__ = ["Held", "Leading", "Looking"]


@runtime_checkable
class Leading(Protocol):
    """What leads a session on, the `Runner`: where it is, and what makes it go on."""

    @property
    def stage(self) -> str:
        """What it is at."""
        ...

    @property
    def step(self) -> int | None:
        """The step of the trial that is being felt."""
        ...

    @property
    def ends(self) -> float:
        """When that step ends, by the monotonic clock."""
        ...

    @property
    def trouble(self) -> str:
        """Why it does not go on."""
        ...

    @property
    def fits_after(self) -> int:
        """Fits that a participant had to wait for."""
        ...

    def restart(self) -> None:
        """Leave what is going on, and begin with what the state says now."""
        ...

    def wake(self) -> None:
        """What is waited for may have happened."""
        ...

    def forget(self) -> None:
        """The rig has no rendering any more."""
        ...


@runtime_checkable
class Looking(Protocol):
    """Who looks, the `Watchers`."""

    @property
    def participant_here(self) -> bool:
        """Whether the participant's page is there."""
        ...


@runtime_checkable
class Held(Protocol):
    """The session. `begun`: the participant has said so, since the server started or the page came back."""

    begun: bool

    @property
    def state(self) -> LiveSession:
        """The fold of the log."""
        ...

    @property
    def rig(self) -> Rig:
        """What shows renderings; there is one from the hub's `open` on."""
        ...

    @property
    def runner(self) -> Leading:
        """What leads it on."""
        ...

    @property
    def watchers(self) -> Looking:
        """Who looks."""
        ...

    @property
    def chooser(self) -> Any:
        """What proposes."""
        ...

    @property
    def compute(self) -> Executor:
        """The thread in which it does so."""
        ...

    @property
    def warm(self) -> asyncio.Future:
        """Done when all that is needed is compiled."""
        ...

    @property
    def tag(self) -> str:
        """What trials are known by in browsers."""
        ...

    @property
    def gap(self) -> float:
        """Pause between two trials, s."""
        ...

    @property
    def delays(self) -> list[dict[str, float]]:
        """Seconds from each answer to parameters in force, in parts."""
        ...

    @property
    def recent(self) -> Sequence[Event]:
        """The newest events, the last one first."""
        ...

    @property
    def without_map(self) -> str:
        """Why there will be no map, in a sentence; empty where nothing hinders it."""
        ...

    @property
    def alert(self) -> str | None:
        """Why nothing can be written."""
        ...

    @property
    def fault(self) -> str | None:
        """What of the watch over the session does not work."""
        ...

    @property
    def trust(self) -> list[list[str]]:
        """How far the map is to be trusted: names and values."""
        ...

    @property
    def draws(self) -> bool:
        """Whether there are slices of the map to be had."""
        ...

    @property
    def invite(self) -> Callable[[Role], dict[str, str]] | None:
        """Makes a new link for a role."""
        ...

    async def commit(self, make: Callable[[LiveSession, float], Event | None], *, mine: bool = False) -> Any:
        """Have an event made from the newest state, on the disk, and counted."""
        ...

    async def map(self) -> dict[str, Any] | None:
        """Slices of the posterior."""
        ...

    def publish(self) -> None:
        """Tell everybody who looks that there is news."""
        ...
