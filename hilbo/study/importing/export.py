"""Import of exports: files to a trial table, by a mapping that is given or proposed. Loads no JAX."""

from collections.abc import Callable, Sequence
from pathlib import Path

from hilbo.errors import InputError, warn_caller
from hilbo.study.file.reading import StudyFile
from hilbo.study.importing.convert import Imported, converted
from hilbo.study.importing.mapping import Mapping
from hilbo.study.importing.raw import read_raw
from hilbo.study.importing.recognise import propose

__all__ = ["OpenMappingError", "import_files"]


class OpenMappingError(InputError):
    """An export that the proposed mapping does not explain whole; `mapping` has the rest, to be filled in."""

    def __init__(self, sentence: str, mapping: Mapping):
        super().__init__(sentence)
        self.mapping = mapping


def import_files(
    paths: Sequence[Path],
    study: StudyFile,
    mapping: Mapping | None = None,
    *,
    source: str = "the mapping",
    note: Callable[[str], object] = warn_caller,
) -> tuple[Imported, Mapping]:
    """Convert exports to one trial table; returns it with the mapping by which it was made.

    **Arguments:** `paths`: files of one export, read as one table. `mapping`: None to propose one. `source`: the
    mapping's file, for messages. `note`: called with one sentence on each doubt. Raises `InputError`, and its subclass
    `OpenMappingError` if a proposed mapping is not complete.
    """
    tables = [read_raw(path) for path in paths]
    for sentence in (sentence for table in tables for sentence in table.notes):
        note(sentence)
    if mapping is None:
        proposal = propose([table.cells for table in tables], study)
        mapping = proposal.mapping
        if proposal.questions:
            raise OpenMappingError(f"{paths[0]}: {' Besides, '.join(proposal.questions)}", mapping)
    return converted(tables, mapping, study, source, note), mapping
