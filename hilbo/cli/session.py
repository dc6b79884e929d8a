"""The commands after live sessions and around them: `hilbo export`, `hilbo participants`.

Their files are written whole or not at all, and nothing is replaced without `--force`.
"""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from hilbo.cli.terminal.console import Force, progress, remark, results, start
from hilbo.errors import InputError

__all__ = ["app_participants", "export"]

app_participants = typer.Typer(
    no_args_is_help=True, rich_markup_mode="markdown", help="The list of participants, by pseudonymous id."
)


def export(
    logs: Annotated[Path, typer.Argument(help="Folder of session logs.", show_default=False)],
    study: Annotated[Path, typer.Option("--study", help="Study file (TOML).")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the tables.")] = Path("tables"),
    plan: Annotated[
        list[Path] | None,
        typer.Option("--plan", help="Also export this plan, so that the report lists deviations from it. Repeatable."),
    ] = None,
    force: Force = False,
) -> None:
    """Write the tables of a folder of session logs, as hilbo report reads them: trials, validation and sets (Psych-DS),
    the study file, and netCDF for xarray and ArviZ."""
    from hilbo.session.export import tables as log_tables
    from hilbo.session.export.netcdf import netcdf
    from hilbo.session.export.psych_ds import psych_ds
    from hilbo.session.plan.plan import check_plan
    from hilbo.study.file.plan_file import read_plan
    from hilbo.study.file.reading import StudyFile

    chosen = StudyFile.load(study)
    plans = list(dict.fromkeys(plan or []))
    for path in plans:
        check_plan(read_plan(path), chosen)
    with results(out, force) as folder, progress() as say:
        say("reading logs")
        sessions = log_tables.read_sessions(logs, chosen, remark)
        say("writing tables")
        if log_tables.computes_sets(sessions):
            start()
        psych_ds(sessions, folder, chosen)
        shutil.copyfile(study, folder / "study.toml")
        for number, path in enumerate(plans, 1):
            shutil.copyfile(path, folder / ("plan.json" if len(plans) == 1 else f"plan-{number}.json"))
        singles = netcdf(sessions, folder / "trials.nc", chosen)
        if not singles and log_tables.validation_table(sessions).empty:
            raise InputError(f"{logs}: its sessions have no responses that count yet; there is nothing to export.")


@app_participants.command("add")
def add(
    table: Annotated[Path, typer.Argument(help="The list, participants.csv.")],
    participant: Annotated[str, typer.Argument(help="Pseudonymous id.")],
    consent_time: Annotated[str, typer.Option(help="Time of consent, ISO 8601.")],
    protocol_number: Annotated[str, typer.Option(help="Number of the ethics approval.")],
    age: Annotated[str, typer.Option(help="Years.")] = "",
    handedness: Annotated[str, typer.Option(help="right, left or both.")] = "",
) -> None:
    """Add a participant and their consent to the list of participants, which is made if there is none."""
    from hilbo.session.plan.participants import add_person

    row = {"participant": participant, "consent_time": consent_time, "protocol_number": protocol_number}
    people = add_person(table, row | {"age": age, "handedness": handedness})
    typer.echo(f"{table}: participant {participant} added, {len(people)} in all", err=True)


@app_participants.command("delete")
def delete(
    folder: Annotated[Path, typer.Argument(help="Folder with logs, tables and exports.")],
    participant: Annotated[str, typer.Argument(help="Pseudonymous id.")],
    yes: Annotated[bool, typer.Option("--yes", help="Confirm the deletion; without it, nothing is changed.")] = False,
) -> None:
    """Delete all data of a participant who withdraws, below a folder, and list what was deleted and what needs manual
    action."""
    from hilbo.session.withdrawal.withdrawal import Withdrawal, delete_participant

    if not yes:
        raise InputError(f"this removes everything of participant {participant} below {folder}; add --yes to do it.")
    done = Withdrawal(participant)
    try:
        delete_participant(folder, participant, done)
    finally:  # also of a withdrawal that an error ends
        _say_done(done)


def _say_done(done) -> None:
    """Print on stderr what a withdrawal (`done`, a `Withdrawal`) has removed, renamed and left, and the commands that
    make results again."""
    for path, count in done.removed.items():
        typer.echo(f"{path}: {count} removed", err=True)
    for path, count in done.renamed.items():
        typer.echo(f"{path}: {count} of what others have stays, under the name {done.label}", err=True)
    for path, why in done.left.items():
        typer.echo(f"{path}: LEFT; {why}", err=True)
    for command in done.commands:
        typer.echo(f"make again: {command}", err=True)
