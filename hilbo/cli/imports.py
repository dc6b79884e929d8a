"""`hilbo import`: a trial table from the export of another program.

hilbo import survey.csv --study study.toml --out trials.csv
hilbo import survey.csv --study study.toml --out trials.csv --mapping trials.mapping.toml
"""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from hilbo.cli.terminal.console import ForceFile, remark
from hilbo.cli.terminal.new_file import check_free, write_new
from hilbo.errors import InputError

__all__ = ["imports"]


def imports(
    files: Annotated[
        list[Path], typer.Argument(help="Export: CSV, .xlsx, Parquet, JSON or JSON Lines; one or several files.")
    ],
    study: Annotated[Path, typer.Option("--study", help="Study file (TOML).")],
    out: Annotated[Path, typer.Option("--out", help="Trial table to write (CSV).")] = Path("trials.csv"),
    mapping: Annotated[
        Path | None, typer.Option("--mapping", help="Corrected mapping file; by default a mapping is proposed.")
    ] = None,
    force: ForceFile = False,
) -> None:
    """Convert the export of another program to a trial table.

    Writes the table, the mapping by which it was made, a record, and, if ids are changed, the list of
    old and new ids.
    """
    if out.suffix != ".csv":
        raise InputError(f"{out}: is no name of a CSV file; choose one that ends in .csv.")
    outputs = {kind: out.with_name(f"{out.stem}.{kind}") for kind in ("mapping.toml", "import.json", "ids.csv")}
    for path in (out, *(path for kind, path in outputs.items() if kind != "mapping.toml" or mapping is None)):
        check_free(path, force)
    from hilbo.study.file.reading import StudyFile
    from hilbo.study.formats.csv_rows import csv_text
    from hilbo.study.importing.export import OpenMappingError, import_files
    from hilbo.study.importing.mapping import mapping_text, read_mapping

    given = None if mapping is None else read_mapping(mapping)
    try:
        made, used = import_files(
            files, StudyFile.load(study), given, source=str(mapping or "the mapping"), note=remark
        )
    except OpenMappingError as error:
        where = outputs["mapping.toml"]
        write_new(where, mapping_text(error.mapping), force)
        raise InputError(f"{error} The rest is in {where}: complete it, then add --mapping {where}.") from None
    if force and not made.ids:  # the list of an earlier import would be of other ids
        outputs["ids.csv"].unlink(missing_ok=True)
    if made.ids:
        rows = [["participant", "id_in_export"], *([new, old] for old, new in made.ids.items())]
        write_new(outputs["ids.csv"], csv_text(rows), force)
    if mapping is None:
        write_new(outputs["mapping.toml"], mapping_text(used), force)
    write_new(outputs["import.json"], json.dumps(made.record, indent=2, ensure_ascii=False) + "\n", force)
    write_new(out, made.table.to_csv(index=False), force)
    for sentence in made.sentences:
        print(sentence, file=sys.stderr)
    print(
        f"{out}: written, by {mapping or outputs['mapping.toml']}; next: hilbo aggregate {out} --study {study}",
        file=sys.stderr,
    )
