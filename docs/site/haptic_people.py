"""Simulated people and materials of the page docs/guides/haptic-study.md, in place of those of a lab."""

import dataclasses
import json
import time
import zlib
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from hilbo import Study
from hilbo.app.rehearsal.rehearsal import Decider
from hilbo.session.choose.logged_session import LoggedSession
from hilbo.session.log import actions
from hilbo.session.log.header_check import protocol_of
from hilbo.session.plan.participants import add_person, read_people
from hilbo.session.plan.plan import planned_header
from hilbo.simulation.presets import preset_of
from hilbo.study.file.plan_file import read_plan

__all__ = ["Lab", "balance", "take_part"]

PROTOCOL = "2026-07"
_EARLY = 5  # trials after which somebody drops out, or has one voided


class Lab(NamedTuple):
    """What a lab would have: `materials`, name -> K0, K1, B1, alpha as the simulated device is pressed against them;
    the `seed` of its people; one participant each who drops out after five trials, guesses throughout, and has a trial
    voided (ids; empty for nobody)."""

    materials: dict[str, tuple[float, float, float, float]]
    seed: int = 0
    drops_out: str = ""
    guesses: str = ""
    voids: str = ""


def take_part(lab: Lab, folder: Path, plan: str, logs: str = "logs", only: str = "") -> str:
    """Let the participants of a plan (all, or `only` one) take part, each after consent; returns a sentence. Answers of
    one participant to one material are those of one simulated person, in whatever session."""
    jax.config.update("jax_enable_x64", True)
    study, whole = Study.load(folder / "haptic.toml"), read_plan(folder / plan)
    names = [row.participant for row in whole.participants if not only or row.participant == only]
    answers = 0
    for name in names:
        consent = _consent(folder / logs / "participants.csv", name)
        header = planned_header(whole, study.file, name, protocol_number=PROTOCOL, consent=consent)
        with LoggedSession.open(folder / logs, study, header) as session:
            answers += sum(1 for _ in _answered(lab, study, name, session))
    return f"{len(names)} participants, {answers} answers"


def _answered(lab: Lab, study: Study, name: str, session: LoggedSession) -> Iterator[int]:
    """Answer the trials of a session; yields the number of each."""
    rng, given = np.random.default_rng([lab.seed, zlib.crc32(name.encode())]), 0
    while session.ask() is not None and not (name == lab.drops_out and given == _EARLY):
        trial = session.state.pending
        assert trial is not None
        block = session.state.header.blocks[trial.block]
        here = study if block.material is None else study.material(block.material)
        decide = _person(lab, here.file.content, block.material or "", name)
        asked = {"renderings": trial.renderings}
        values = {ask: decide(asked, ask) for ask in protocol_of(study.file, block).asks}
        if name == lab.guesses:
            values = {ask: v if ask == "preferred" else str(rng.choice(here.responses)) for ask, v in values.items()}
        first, *_ = values
        session.tell(values.pop(first), **values)
        given += 1
        yield given
        if name == lab.voids and given == _EARLY:
            session.log.append(actions.void(session.state, trial.id, "the handle was touched", time.time()))


@cache
def _decider(content: str, truth: tuple[tuple[str, float], ...], seed: int) -> Decider:
    """The person of a seed, to whom the material with the parameters `truth` is the real one."""
    study = Study.from_dict({"schema": 1} | json.loads(content))
    return Decider(study, dataclasses.replace(preset_of("paper"), truth=dict(truth)), seed)


def _person(lab: Lab, content: str, material: str, name: str) -> Decider:
    """The simulated person `name` as they judge one material."""
    truth = tuple(zip(("K1", "B1", "alpha"), lab.materials[material][1:], strict=True))
    return _decider(content, truth, zlib.crc32(f"{lab.seed} {name} {material}".encode()))


def _consent(path: Path, name: str) -> str:
    """Enter a participant into the list, unless they are there; returns the time of their consent."""
    known = read_people(path) if path.exists() else {}
    if name not in known:
        number = zlib.crc32(name.encode())
        row = {"participant": name, "consent_time": "2026-03-02T10:00", "protocol_number": PROTOCOL}
        row |= {"age": str(19 + number % 12), "handedness": "right" if number % 9 else "left"}
        known = add_person(path, row)
    return known[name]["consent_time"]


def balance(folder: Path, plan: str) -> str:
    """Balance of a plan of comparisons, in lines: how many participants have which order of materials; and of the sets
    of a participant, in how many comparisons they stand on side a and are felt first."""
    rows = read_plan(folder / plan).participants
    of_phase = [[block for block in row.header.blocks if block.phase != "warm-up"] for row in rows]
    orders = Counter(", ".join(block.material or "" for block in blocks) for blocks in of_phase)
    lines = [f"{count} participant{'s' * (count > 1)}: {order}" for order, count in sorted(orders.items())]
    shares: dict[str, list[tuple[int, int, int]]] = {}
    for block in (block for blocks in of_phase for block in blocks):
        for name in dict.fromkeys(name for trial in block.trials for name in (trial.a, trial.b)):
            with_it = [trial for trial in block.trials if name in (trial.a, trial.b)]
            first = sum(name == (trial.a if trial.first == "a" else trial.b) for trial in with_it)
            count = len(with_it), sum(name == trial.a for trial in with_it), first
            shares.setdefault(block.material or "", []).append(count)
    for material, counts in sorted(shares.items()):
        for (total, on_a, first), sets in sorted(Counter(counts).items()):
            lines.append(
                f"{material}: {sets} sets in {total} comparisons each, on side a in {on_a}, felt first in {first}"
            )
    return "\n".join(lines)
