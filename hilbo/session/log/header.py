"""What a session is to be, before it begins: its blocks, its warm-up, and the seeds of what is chosen in it."""

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
    """A seed below 2^31 for a place in a study, from the study's."""
    return int(np.random.SeedSequence([seed, *place]).generate_state(1)[0] >> 1)


def participant_seed(seed: int, participant: str) -> int:
    """The seed of a person's sessions, from the study's and their id: people who are planned in several batches, or
    without a plan, do not meet the same points, so that all of them together cover the space."""
    return seed_of(seed, int.from_bytes(hashlib.sha256(participant.encode()).digest()[:4]))


def material_seed(header: Header, material: str | None) -> int:
    """The seed of what is chosen with a material, from the session's, the material's name and the session's label:
    points that came again in the same order would be recognised, and no order balances that. Without a material, and
    with the label "1", it is the session's own, as `hilbo.Session` has it.
    """
    name = (material or "") + ("" if header.session == "1" else f"\n{header.session}")  # neither has a line's end in it
    digest = hashlib.sha256(name.encode()).digest()
    return seed_of(header.seed, int.from_bytes(digest[:4])) if name else header.seed


def warm_up(study: StudyFile, seed: int, material: str | None = None) -> tuple[Block, dict[str, dict[str, float]]]:
    """The warm-up: spread, feasible renderings from the seed, as many again for "another one"; and their sets."""
    from hilbo.search.rendering import Rendering  # with JAX, which nothing else here needs
    from hilbo.search.space import SearchSpace

    count = protocol(study.session, "warm-up").count
    box = study_of(study, material).space
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
    """An optimisation session: a warm-up, then the study's trials with each material. `others`: fields of Header."""
    blocks, sets = [], {}
    if warm:
        block, sets = warm_up(study, seed, materials[0])
        blocks.append(block)
    rest = protocol(study.session, "optimisation").rest
    for i, name in enumerate(materials):
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
    """The header of a session of these blocks, with what it says of the study."""
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
