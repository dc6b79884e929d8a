"""The commands around live sessions: `hilbo plan`, `hilbo export`, `hilbo participants`.

Their files are written whole or not at all, and nothing is replaced without `--force`.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from hilbo.cli.terminal.console import (
    Force,
    ForceFile,
    JsonToo,
    check_choice,
    progress,
    remark,
    results,
    seed_option,
    start,
)
from hilbo.cli.terminal.new_file import check_free, write_new
from hilbo.errors import InputError
from hilbo.study.disk.lock import locked_folder

__all__ = ["app_participants", "export", "plan"]

StudyPath = Annotated[Path, typer.Argument(help="Study file (TOML).", show_default=False)]
app_participants = typer.Typer(
    no_args_is_help=True, rich_markup_mode="markdown", help="The list of participants, by pseudonymous id."
)


def plan(
    study: StudyPath,
    out: Annotated[Path, typer.Option("--out", help="File for the plan.")] = Path("plan.json"),
    participants: Annotated[int | None, typer.Option(min=1, help="How many people: P01, P02, ...")] = None,
    names: Annotated[str | None, typer.Option(help="Their ids instead, separated by commas.")] = None,
    kind: Annotated[str, typer.Option(help="optimisation, validation or aggregate-best.")] = "optimisation",
    results_: Annotated[
        list[str] | None, typer.Option("--from", help="result.json of the optimisation; MATERIAL=PATH for several.")
    ] = None,
    trials: Annotated[Path | None, typer.Option(help="For a validation: the table or logs it was made from.")] = None,
    material: Annotated[list[str] | None, typer.Option(help="Only this material; may be repeated.")] = None,
    source: Annotated[str, typer.Option(help="For a validation: aggregate or individual.")] = "aggregate",
    session: Annotated[str, typer.Option(help="Label of the session in tables and names of logs.")] = "",
    reissue: Annotated[str | None, typer.Option(help="OLD=NEW: give NEW the row of OLD in the plan --out.")] = None,
    register: Annotated[
        Path | None, typer.Option("--register", help="Besides, one page for a pre-registration, in Markdown.")
    ] = None,
    seed: Annotated[int, seed_option("of orders, and of every session")] = 0,
    force: ForceFile = False,
    as_json: JsonToo = False,
) -> None:
    """Plan a whole study in advance: orders, seeds and validation sets, with a hash that every log will hold.

    Writes the plan to --out; with --reissue changes the plan there.
    """
    from hilbo.study.file.protocols import PHASES
    from hilbo.study.file.reading import StudyFile

    file = StudyFile.load(study)
    if register is not None:
        _check_register(register, out, reissue, force)
    if reissue is not None:
        with locked_folder(out.resolve().parent):
            _write_plan(_reissued(out, study, file, reissue, results_ or []), out, True, as_json)
        return
    check_choice("kind", kind, PHASES[1:])
    check_choice("source", source, ("aggregate", "individual"))
    people = _people(participants, names, "P" if kind == "optimisation" or source == "individual" else "V")
    materials = tuple(material or file.materials)
    for name in materials:
        file.material(name)  # refuses what is none
    paths = {} if kind == "optimisation" else _by_material(materials, results_ or [])
    check_free(out, force)
    content = _plan_of(study, kind, source, people, materials, paths, trials, session, seed)
    check_free(out, force)  # it may have been made in the meantime
    _write_plan(content, out, force, as_json)
    if register is not None:
        _write_registration(file, content, register, force)


def export(
    logs: Annotated[Path, typer.Argument(help="Folder of session logs.", show_default=False)],
    study: Annotated[Path, typer.Option("--study", help="Study file (TOML).")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the tables.")],
    plan: Annotated[
        Path | None, typer.Option("--plan", help="The plan, which is put there too: the report says what departs.")
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
    if plan is not None:
        check_plan(read_plan(plan), chosen)
    with results(out, force) as folder, progress() as say:
        say("reading logs")
        sessions = log_tables.read_sessions(logs, chosen, remark)
        say("writing tables")
        if log_tables.computes_sets(sessions):
            start()
        psych_ds(sessions, folder, chosen)
        shutil.copyfile(study, folder / "study.toml")
        if plan is not None:
            shutil.copyfile(plan, folder / "plan.json")
        singles = netcdf(sessions, folder / "trials.nc", chosen)
        if not singles and log_tables.validation_table(sessions).empty:
            raise InputError(f"{logs}: its sessions hold no answers that count yet; there is nothing to export.")


@app_participants.command("add")
def add(
    table: Annotated[Path, typer.Argument(help="The list, participants.csv.")],
    participant: Annotated[str, typer.Argument(help="Pseudonymous id.")],
    consent_time: Annotated[str, typer.Option(help="When they agreed, ISO 8601.")],
    protocol_number: Annotated[str, typer.Option(help="Number of the ethics approval.")],
    age: Annotated[str, typer.Option(help="Years.")] = "",
    handedness: Annotated[str, typer.Option(help="right, left or both.")] = "",
) -> None:
    """Add a participant and their consent to the list of participants, which is made if there is none."""
    from hilbo.session.plan.participants import add_person

    row = {"participant": participant, "consent_time": consent_time, "protocol_number": protocol_number}
    add_person(table, row | {"age": age, "handedness": handedness})


@app_participants.command("delete")
def delete(
    folder: Annotated[Path, typer.Argument(help="Folder with logs, tables and exports.")],
    participant: Annotated[str, typer.Argument(help="Pseudonymous id.")],
    yes: Annotated[bool, typer.Option("--yes", help="Do it; without, nothing is touched.")] = False,
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


def _plan_of(
    path: Path,
    kind,
    source,
    people: list[str],
    materials: tuple[str, ...],
    paths: dict[str, Path],
    trials: Path | None,
    session: str,
    seed: int,
) -> Any:
    """A new plan; `paths`: material -> result.json, from which the sets of a validation are made. Prints what a
    device's delay leaves of the search space. Raises `InputError`."""
    start()
    from hilbo.session.plan.plan import make_plan

    with progress() as say:
        study = None if kind == "optimisation" else _load_study(path)
        file = _searchable(path) if study is None else study.file
        _say_delays(file, materials)
        return make_plan(
            file,
            people,
            seed,
            kind,
            materials=materials,
            session=session or {"optimisation": "1", "validation": "2", "aggregate-best": "3"}[kind],
            sets=None if study is None else _sets(study, kind, paths, trials, source, people, say),
            source=source if kind == "validation" else None,
        )


def _people(count, names: str | None, letter: str) -> list[str]:
    """The ids of the participants: the `names`, separated by commas, or `count` numbers after a letter (P01, P02).
    Raises `InputError` unless exactly one of both is given."""
    if (count is None) == (names is None):
        raise InputError("plan: give either --participants (how many) or --names.")
    if names is not None:
        return [name.strip() for name in names.split(",")]
    width = max(2, len(str(count)))
    return [f"{letter}{i + 1:0{width}d}" for i in range(count)]


def _searchable(path: Path) -> Any:
    """The study file, checked to have parameters that a device can render passively; no model is needed to plan an
    optimisation. Raises `InputError`."""
    from hilbo.search.space import SearchSpace
    from hilbo.study.file.reading import StudyFile, read_study

    def search_space_of(file: StudyFile) -> StudyFile:
        SearchSpace(file.space.parameters, file.space.mechanics)  # refuses a space without a passive set
        return file

    return read_study(path, search_space_of)


def _say_delays(study, materials) -> None:
    """Print on stderr what the delay of the device leaves of the search space, for each material; nothing without a
    delay."""
    from hilbo.search.rendering import delay_words
    from hilbo.search.space import SearchSpace

    for name in materials or ("",):
        box = (study.material(name) if name else study).space
        if box.mechanics is not None and box.mechanics.delay:
            remark((f"{name}: " if name else "") + delay_words(SearchSpace(box.parameters, box.mechanics)))


def _load_study(path: Path) -> Any:
    """The study of a file, with its model. Raises `InputError`."""
    from hilbo.study.config import Study

    return Study.load(path)


def _sets(study, kind, paths, trials, source, people, say) -> dict[str, Any]:
    """Material ("" without) -> name -> parameters of the sets that validations compare, from the results in `paths`
    (material -> result.json). Raises `InputError` if they do not fit the study or the participants, or --trials is
    missing."""
    from hilbo.session.export.tables import read_log_trials
    from hilbo.session.plan import validation_sets
    from hilbo.study.cohort import cohort_of, read_trials
    from hilbo.study.results.result_json import read_result

    sets = {}
    for material, path in paths.items():
        here = study.material(material) if material else study
        result = read_result(path, here)
        if kind == "aggregate-best":
            sets[material] = validation_sets.aggregate_best_sets(here, result)
            continue
        validation_sets.check_participants(result, people, source)
        if trials is None:
            raise InputError("plan: a validation reads the map itself; give --trials, the answers it was made from.")
        say(f"the map of {material or study.file.name}")
        if trials.is_dir():
            table = read_log_trials(trials, study.file, material or None, note=remark)
        else:
            table = read_trials(trials, here, material or None)
        sets[material] = validation_sets.validation_sets(here, result, cohort_of(table, here), source, people)
    return sets


def _by_material(materials: Sequence[str], given: Sequence[str]) -> dict[str, Path]:
    """Material ("" without) -> path, from the texts of --from: one path, or MATERIAL=PATH for each material. Raises
    `InputError` for any other choice."""
    if not given:
        raise InputError("plan: give --from result.json, of which the sets are made.")
    if len(given) == 1 and len(materials) <= 1 and "=" not in given[0]:
        return {"".join(materials): Path(given[0])}
    pairs = [text.partition("=") for text in given]
    if sorted(name for name, _, _ in pairs) != sorted(materials) or not materials:
        names = ", ".join(materials) or "none, so that one --from result.json is all"
        raise InputError(f"plan: give --from MATERIAL=result.json once for each material ({names}).")
    return {name: Path(path) for name, _, path in pairs}


def _reissued(path: Path, study_path: Path, study, text: str, results_: list[str]) -> Any:
    """The plan of the file `path` for the study file `study`, with the row of one participant given to another by the
    `text` OLD=NEW; nothing is written. Raises `InputError`."""
    from hilbo.session.plan.plan import check_plan, reissue
    from hilbo.study.file.plan_file import read_plan

    old, equals, new = text.partition("=")
    if not equals:
        raise InputError(f'--reissue is "{text}"; write OLD=NEW.')
    if not path.exists():
        raise InputError(f"{path}: is not there; give the plan to change with --out.")
    plan = read_plan(path)
    check_plan(plan, study)
    changed = reissue(plan, old.strip(), new.strip())
    if plan.phase == "validation" and plan.source == "aggregate":
        materials = tuple(name for name in plan.materials if name is not None)
        _check_not_in_map(path, study_path, materials, results_, new.strip())
    return changed


def _check_not_in_map(path: Path, study_path: Path, materials: Sequence[str], results_: list[str], new: str) -> None:
    """Raise `InputError` if the participant `new` contributed to the aggregate that the plan validates, or if no result
    files (`results_`) are given: only these name them."""
    if not results_:
        raise InputError(
            f"{path}: validates an aggregate, by people who are not in it; add --from result.json, of which its sets"
            f" are made, so that {new} can be looked for there."
        )
    start()
    from hilbo.session.plan.validation_sets import check_participants
    from hilbo.study.results.result_json import read_result

    study = _load_study(study_path)
    for material, source in _by_material(materials, results_).items():
        result = read_result(source, study.material(material) if material else study)
        check_participants(result, [new], "aggregate")


def _check_register(register: Path, out: Path, reissue: str | None, force: bool) -> None:
    """Raise `InputError` if --register is given with --reissue, names the file of the plan, or a file that may not be
    written."""
    if reissue is not None:
        raise InputError("--register belongs to a new plan, and --reissue changes one; the page of the old plan stays.")
    if register.resolve() == out.resolve():
        raise InputError(f"--register is {register}, where the plan is to be; name another file.")
    check_free(register, force)


def _write_registration(file, plan, out: Path, force: bool) -> None:
    """Write the page for a pre-registration of a plan of the study `file`, and print a remark on it on stderr."""
    from hilbo import __version__
    from hilbo.report.registration import registration

    write_new(out, registration(file, plan, __version__), force)
    typer.echo(f"{out}: read it, and fill in what is to be written by you", err=True)


def _write_plan(plan, out: Path, force: bool, as_json: bool) -> None:
    """Write a plan to a file, and print on stderr whether its orders are balanced; with `as_json` the plan on
    stdout."""
    from hilbo.study.file.plan_file import plan_text

    text = plan_text(plan)
    write_new(out, text, force)
    complete = "complete blocks" if plan.complete else f"incomplete: balance is exact at {plan.complete_at}"
    typer.echo(f"{out}: {len(plan.participants)} participants, {complete}, hash {plan.hash}", err=True)
    if as_json:
        typer.echo(text, nl=False)
