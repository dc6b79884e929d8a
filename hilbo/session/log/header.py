"""Headers of sessions before they begin: blocks, warm-up, and random seeds."""

import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from hilbo.session.log.header_check import study_of
from hilbo.session.log.records import Header
from hilbo.study.file.plan_file import Block, Planned
from hilbo.study.file.protocols import protocol
from hilbo.study.file.reading import StudyFile

__all__ = ["header_for", "header_of", "material_seed", "participant_seed", "seed_of", "warm_up"]

_SPARE = 2  # warm-up renderings in store: so many times the least number


def seed_of(seed: int, *place: int) -> int:
    """Derive a seed below 2^31 from the study's seed and the integers `place`."""
    return int(np.random.SeedSequence([seed, *place]).generate_state(1)[0] >> 1)


def participant_seed(seed: int, participant: str) -> int:
    """Derive the seed of a participant's sessions from the study's seed and the id, so that participants who are
    planned in several batches, or without a plan, are not given the same points, and together cover the space."""
    return seed_of(seed, int.from_bytes(hashlib.sha256(participant.encode()).digest()[:4]))


def material_seed(header: Header, material: str | None) -> int:
    """Derive the seed for the choices with one material from the session's seed, the material's name and the session's
    label, so that no participant meets the same points in the same order twice. Without a material and with the label
    "1" it is the session's own seed, as in `hilbo.Session`."""
    name = (material or "") + ("" if header.session == "1" else f"\n{header.session}")  # neither has a line's end in it
    digest = hashlib.sha256(name.encode()).digest()
    return seed_of(header.seed, int.from_bytes(digest[:4])) if name else header.seed


def warm_up(study: StudyFile, seed: int, material: str | None = None) -> tuple[Block, dict[str, dict[str, float]]]:
    """Return a warm-up block of space-filling, feasible renderings, and their sets (name -> parameters in physical
    units).

    The block has twice as many planned trials as it needs, in store for "another one". Loads JAX.
    """
    from hilbo.search.rendering import Rendering  # with JAX, which nothing else here needs
    from hilbo.search.space import SearchSpace

    here = study_of(study, material)
    count, box = protocol(here.session, "warm-up").count, here.space
    space = SearchSpace(box.parameters, box.mechanics, box.constraints)
    unit = np.concatenate([space.latin_hypercube(count, seed_of(seed, k)) for k in range(_SPARE)])
    renderings = [Rendering.of(space, row) for row in np.asarray(space.to_physical(unit))]
    sets = {f"warm-up {number}": rendering.values for number, rendering in enumerate(renderings, 1)}
    return Block("warm-up", count, tuple(Planned(name) for name in sets), material), sets


def header_for(
    study: StudyFile,
    participant: str,
    session: str = "1",
    seed: int = 0,
    *,
    materials: Sequence[str | None] = (None,),
    warm: bool = True,
    **others: Any,
) -> Header:
    """Return the header of an optimisation session: a warm-up (unless `warm` is False), then the study's number of
    trials with each of the `materials`. `others`: further fields of Header."""
    blocks, sets = [], {}
    if warm:
        block, sets = warm_up(study, seed, materials[0])
        blocks.append(block)
    for i, name in enumerate(materials):
        rest = protocol(study_of(study, name).session, "optimisation").rest
        blocks.append(Block("optimisation", study.selection.trials, material=name, rest=rest if i else 0.0))
    return header_of(study, participant, session, seed, blocks, sets, **others)


def header_of(
    study: StudyFile,
    participant: str,
    session: str,
    seed: int,
    blocks: Sequence[Block],
    sets: dict[str, dict[str, float]],
    **others: Any,
) -> Header:
    """Return the header of a session with these blocks; hash and language are the study's. `others`: further fields of
    Header."""
    return Header(
        study=study.hash,
        participant=participant,
        session=session,
        seed=seed,
        blocks=tuple(blocks),
        sets=sets,
        language=study.session.language,
        **others,
    )
