"""The data of the page of `hilbo try`, which presents the blocks, takes the answers and shows the map at the end.

The page (static/try.js) is the stimulus and the participant of an ordinary session at once. It renders the reference
too, and so has to know its parameters: such answers are unblinded, and the log says so. Displacement follows force by
the recursion of the firmware's core with full memory, solved for the position; `FIXED` are the model's parameters that
the study does not vary. Loads no JAX before it is needed.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from hilbo.app.interface import HubInterface
from hilbo.errors import InputError
from hilbo.study.file.protocols import protocol
from hilbo.study.file.reading import StudyFile

__all__ = ["FIXED", "NAMES", "STATES", "Tried", "check_study", "hidden_reference"]

NAMES = ("K1", "B1", "alpha")
STATES = 10
FIXED = {"K0": 0.3, "T": 1e-3}
"""K0 (N/mm), the static stiffness, and T (s), the time between two samples."""
_ANSWERS = 3  # buttons of the page
_MIDDLE = (0.2, 0.8)  # of each range: where the reference may be, so that answers surround it


class Tried:
    """Makes the data that only the page of `hilbo try` gets. `reference`: parameter -> value in physical units, hidden
    from the person."""

    def __init__(self, study: StudyFile, reference: Mapping[str, float]):
        self._study, self._reference = study, dict(reference)

    async def facts(self, _hub: HubInterface) -> dict[str, Any]:
        """What the page needs to render: K0 and T, the parameters of the reference, and the coefficients of the
        exponentials."""
        from hilbo.mechanics.exponentials import TABLE

        return FIXED | {"reference": self._reference, "table": TABLE[STATES]}

    async def map(self, hub: HubInterface) -> dict[str, Any]:
        """The slices of the person's own map, and for each parameter its range, hidden value and optimum, in the
        study's unit and on [0, 1]; empty while the slices are being computed. Raises `InputError` before the last
        answer."""
        if hub.state.screen not in ("done", "ended"):
            raise InputError("The map is shown after the last answer.")
        slices = await hub.map()
        if not slices:
            return {}
        best = {s[axis]: s["best"][i] for s in slices["slices"] for i, axis in enumerate(("across", "up"))}
        return slices | {"parameters": [self._compared(i, best) for i in range(self._study.space.dim)]}

    def _compared(self, i: int, best: Mapping[str, float]) -> dict[str, Any]:
        """Range, hidden value and optimum of parameter `i`; `best`: name -> optimum in the unit cube."""
        parameter = self._study.space.parameters[i]
        hidden, optimum = self._reference[parameter.name], best[parameter.name]
        return {
            "name": parameter.name, "unit": parameter.unit, "scale": parameter.scale,
            "low": parameter.low, "high": parameter.high,
            "hidden": hidden, "hidden_unit": float(parameter.to_unit(np.asarray(hidden))),
            "optimum": float(parameter.to_physical(np.asarray(optimum))), "optimum_unit": optimum,
        }  # fmt: skip


def check_study(study: StudyFile) -> None:
    """Raise `InputError` unless the page of `hilbo try` can present the study: K1, B1 and alpha of one material,
    presented by a program and shown to the experimenter, three responses, and one step with the rendering."""
    if study.space.mechanics is not None or study.stimulus is None:
        raise InputError(f"{study.source}: has a [renderer], and hilbo try presents by itself; use one without it.")
    if study.stimulus.by == "person" or study.stimulus.experimenter_sees is False:
        raise InputError(
            f"{study.source}: the page of hilbo try presents by itself and shows the map at the end; leave by and"
            " experimenter_sees out of [stimulus]."
        )
    if set(study.space.names) != set(NAMES) or study.materials:
        raise InputError(f"{study.source}: hilbo try presents {', '.join(NAMES)} of one material, and nothing else.")
    if len(study.responses) != _ANSWERS:
        raise InputError(f"{study.source}: has {len(study.responses)} responses; the page of hilbo try has three.")
    if [step.show for step in protocol(study.session, "optimisation").steps] != ["a"]:
        raise InputError(
            f"{study.source}: hilbo try shows test and reference at once; write under [session.optimisation]"
            ' steps = [{show = "a", seconds = 600}].'
        )


def hidden_reference(study: StudyFile, seed: int) -> dict[str, float]:
    """The hidden reference of a seed: parameter -> value in physical units, uniform in the middle 60 % of each range
    (on its scale)."""
    unit = np.random.default_rng([seed, len(NAMES)]).uniform(*_MIDDLE, study.space.dim)
    return {p.name: float(p.to_physical(u)) for p, u in zip(study.space.parameters, unit, strict=True)}
