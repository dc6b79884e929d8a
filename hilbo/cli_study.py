"""The commands of a whole study: `hilbo validate`, `hilbo power` and `hilbo report`."""

from pathlib import Path
from typing import Annotated, Any

import typer

from hilbo.console import Force, Json, Out, Seed, finish, progress, results, start

__all__ = ["power", "report", "validate"]

StudyFile = Annotated[Path, typer.Option("--study", help="Study file (TOML).")]


def validate(
    responses: Annotated[Path, typer.Argument(help="Validation table (CSV or Parquet).", show_default=False)],
    study: StudyFile,
    out: Out,
    sets: Annotated[Path | None, typer.Option(help="Sets table: what each set is, and where it is from.")] = None,
    material: Annotated[str | None, typer.Option(help="Only this one of the table's materials.")] = None,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """What the validation sessions say: confusion matrix, preferences, and the paper's tables II to IV."""
    with results(out, force) as folder, progress() as say:
        start()
        from hilbo.config import Study
        from hilbo.report_validation import write_validation

        content = write_validation(Study.load(study), responses, sets, material, folder, seed, say)
    finish(content, out, as_json)
