"""A study's sessions in advance: who is shown what, in which order, from one seed.

`header_for` is one session; `make_plan` a whole study, whose hash stands in every log.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from hilbo.config import Study
from hilbo.live_records import Block, Header, Planned
from hilbo.trial_protocols import protocol

__all__ = ["header_for", "warm_up"]

_SPARE = 2  # warm-up renderings in store: so many times the least number


def warm_up(study: Study, seed: int, material: str | None = None) -> tuple[Block, dict[str, dict[str, float]]]:
    """The warm-up: spread, feasible renderings from the seed, as many again for "another one"; and their sets."""
    count = protocol(study.session, "warm-up").count
    space = (study if material is None else study.material(material)).space
    unit = np.concatenate([space.latin_hypercube(count, seed + 1_000_003 * (k + 1)) for k in range(_SPARE)])
    physical = np.asarray(space.to_physical(unit))
    names = [f"warm-up {i + 1}" for i in range(len(physical))]
    sets = {n: dict(zip(space.names, row, strict=True)) for n, row in zip(names, physical.tolist(), strict=True)}
    return Block("warm-up", count, tuple(Planned(n) for n in names), material), sets


def header_for(
    study: Study,
    participant: str,
    session: str = "1",
    seed: int = 0,
    *,
    materials: Sequence[str | None] = (None,),
    warm: bool = True,
    **others: Any,
) -> Header:
    """An optimisation session: a warm-up, then the study's trials with each material. `others`: fields of Header."""
    blocks, sets = [], {}
    if warm:
        block, sets = warm_up(study, seed, materials[0])
        blocks.append(block)
    for name in materials:
        blocks.append(Block("optimisation", study.selection.trials, material=name))
    return Header(
        study=study.hash,
        participant=participant,
        session=session,
        seed=seed,
        blocks=tuple(blocks),
        sets=sets,
        **others,
    )
