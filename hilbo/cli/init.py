"""`hilbo init`: a commented study file to begin with.

hilbo init study.toml --parameter hue=140:260:deg --parameter light=20:80:%
hilbo init study.toml --parameter a=0:2:mm --parameter b=0:2:mm --constraint "a + 2*b <= 3"
hilbo init study.toml --by device
"""

import sys
from pathlib import Path
from typing import Annotated

import typer

from hilbo.cli.terminal.console import check_choice
from hilbo.cli.terminal.new_file import check_free, write_new

__all__ = ["init"]


def init(
    study: Annotated[Path, typer.Argument(help="Study file to write.")] = Path("study.toml"),
    name: Annotated[str | None, typer.Option(help="Name of the study; by default that of the file.")] = None,
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            help="NAME=LOW:HIGH:UNIT, followed by :log for a logarithmic scale, or by :integer; or"
            " NAME=LEVEL,LEVEL,LEVEL; or NAME=LOW<MEDIUM<HIGH for ordered levels. Repeatable."
        ),
    ] = None,
    constraint: Annotated[
        list[str] | None,
        typer.Option(
            help="Linear constraint in physical units, e.g. 'a + 2*b <= 3', '0 <= a - b <= 1', 'a + b = 1'. Repeatable."
        ),
    ] = None,
    responses: Annotated[str, typer.Option(help="Response categories, lowest first.")] = "different,similar,close",
    goal: Annotated[str, typer.Option(help="The response to maximise; by default the highest.")] = "",
    trials: Annotated[int, typer.Option(min=1, help="Number of trials per participant.")] = 25,
    by: Annotated[
        str,
        typer.Option(help="Who presents: your own program, a person, or the haptic device (program, person, device)."),
    ] = "program",
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
) -> None:
    """Write a commented study file with the name, parameters and answers given."""
    check_free(study, force)
    from hilbo.study.template import NewStudy, parameter_of, study_text

    parameters = tuple(parameter_of(text) for text in parameter or [])
    check_choice("by", by, ("program", "person", "device"))
    answers = tuple(text.strip() for text in responses.split(","))
    device, presenter = by == "device", "person" if by == "person" else "program"
    limits = tuple(constraint or ())
    new = NewStudy(name or study.stem, parameters, answers, trials, device, presenter, goal.strip(), limits)
    text = study_text(new)
    write_new(study, text, force)
    print(f"{study}: written; read it, then hilbo doctor {study}", file=sys.stderr)
