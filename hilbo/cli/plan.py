"""The command `hilbo plan`: plans of a study's sessions, from its study file and the results of earlier sessions."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from hilbo.cli.terminal.console import ForceFile, JsonToo, check_choice, progress, remark, seed_option, start
from hilbo.cli.terminal.new_file import check_free, write_new
from hilbo.errors import InputError
from hilbo.study.disk.lock import locked_folder

__all__ = ["plan"]

StudyPath = Annotated[Path, typer.Argument(help="Study file (TOML).", show_default=False)]


def plan(
    study: StudyPath,
    out: Annotated[Path, typer.Option("--out", help="File for the plan.")] = Path("plan.json"),
    participants: Annotated[
        int | None,
        typer.Option(
            min=1, help="Number of participants: P01, P02, ...; default: [plan] people, or all in the results."
        ),
    ] = None,
    names: Annotated[str | None, typer.Option(help="Ids of the participants, separated by commas.")] = None,
    kind: Annotated[str, typer.Option(help="optimisation, validation or aggregate-best.")] = "optimisation",
    results_: Annotated[
        list[str] | None, typer.Option("--from", help="result.json of the optimisation; MATERIAL=PATH for several.")
    ] = None,
    table: Annotated[
        Path | None, typer.Option(help="For a validation: trial table, or folder of logs, of which the results are.")
    ] = None,
    material: Annotated[list[str] | None, typer.Option(help="Use only this material. Repeatable.")] = None,
    source: Annotated[str, typer.Option(help="For a validation: aggregate or individual.")] = "aggregate",
    session: Annotated[str, typer.Option(help="Label of the session in tables and names of logs.")] = "",
    reissue: Annotated[
        str | None, typer.Option(help="OLD=NEW: reassign the plan slot of a drop-out (OLD) to a new participant (NEW).")
    ] = None,
    register: Annotated[
        Path | None, typer.Option("--register", help="Also write a page for preregistration, in Markdown.")
    ] = None,
    seed: Annotated[int, seed_option("of orders, and of every session")] = 0,
    force: ForceFile = False,
    as_json: JsonToo = False,
) -> None:
    """Plan a whole study in advance: orders, seeds and validation sets, with a hash that every log will contain.

    An optimisation of a study with `[plan] people` assigns each participant to one material at random. With --source
    individual everybody is validated with the materials of which they have a map.

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
    materials = tuple(material or file.materials)
    for name in materials:
        file.material(name)  # refuses an invalid one
    paths = {} if kind == "optimisation" else _by_material(materials, results_ or [])
    if kind == "optimisation" and not material and file.plan.people:
        materials = ()
        participants = sum(file.plan.people.values()) if (participants, names) == (None, None) else participants
    own = kind == "validation" and source == "individual"
    everybody = own and (participants, names) == (None, None)
    people = [] if everybody else _people(participants, names, "P" if kind == "optimisation" or own else "V")
    check_free(out, force)
    content = _plan_of(study, kind, source, people, materials, paths, table, session, seed)
    check_free(out, force)  # it may have been made in the meantime
    _write_plan(content, out, force, as_json)
    if register is not None:
        _write_registration(file, content, register, force)


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
    """A new plan; `paths`: material -> result.json, from which the sets of a validation are made; `people`: empty for
    everybody in the results. Prints what a device's delay leaves of the search space. Raises `InputError`."""
    start()
    from hilbo.session.plan.plan import make_plan

    with progress() as say:
        study = None if kind == "optimisation" else _load_study(path)
        file = _searchable(path) if study is None else study.file
        _say_delays(file, materials or file.materials)
        by_material = {} if study is None else _results_of(study, paths)
        people = people or sorted(
            {person.participant for result in by_material.values() for person in result.participants}
        )
        return make_plan(
            file,
            people,
            seed,
            kind,
            materials=materials,
            session=session or {"optimisation": "1", "validation": "2", "aggregate-best": "3"}[kind],
            sets=None if study is None else _sets(study, kind, by_material, trials, source, people, say),
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


def _results_of(study, paths: dict[str, Path]) -> dict[str, Any]:
    """Material ("" without) -> its result, read from `paths` (material -> result.json). Raises `InputError`."""
    from hilbo.study.results.result_json import read_result

    return {name: read_result(path, study.material(name) if name else study) for name, path in paths.items()}


def _sets(study, kind, by_material, trials, source, people, say) -> dict[str, Any]:
    """Material ("" without) -> name -> parameters of the sets that validations compare, from the results `by_material`
    (material -> result). Raises `InputError` if they do not fit the study or the participants, or --table is
    missing."""
    from hilbo.session.export.tables import read_log_trials
    from hilbo.session.plan import validation_sets
    from hilbo.study.cohort import cohort_of, read_trials

    if kind != "aggregate-best":
        validation_sets.check_participants(by_material.values(), people, source)
        if trials is None:
            raise InputError("plan: a validation reads the map itself; give --table, the responses it was made from.")
    sets = {}
    for material, result in by_material.items():
        here = study.material(material) if material else study
        if kind == "aggregate-best":
            sets[material] = validation_sets.aggregate_best_sets(here, result)
            continue
        say(f"the map of {material or study.file.name}")
        if trials.is_dir():
            table = read_log_trials(trials, study.file, material or None, note=remark)
        else:
            table = read_trials(trials, here, material or None)
        sets[material] = validation_sets.validation_sets(here, result, cohort_of(table, here), source, people, remark)
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

    by_material = _results_of(_load_study(study_path), _by_material(materials, results_))
    check_participants(by_material.values(), [new], "aggregate")


def _check_register(register: Path, out: Path, reissue: str | None, force: bool) -> None:
    """Raise `InputError` if --register is given with --reissue, names the file of the plan, or a file that may not be
    written."""
    if reissue is not None:
        raise InputError("--register belongs to a new plan, and --reissue changes one; the page of the old plan stays.")
    if register.resolve() == out.resolve():
        raise InputError(f"--register is {register}, where the plan is to be; name another file.")
    check_free(register, force)


def _write_registration(file, plan, out: Path, force: bool) -> None:
    """Write the page for a pre-registration of a plan of the study `file`, and print a remark on it on stderr. Raises
    `InputError` if the file `out` exists, unless `force`."""
    from hilbo import __version__
    from hilbo.report.registration import registration

    write_new(out, registration(file, plan, __version__), force)
    typer.echo(f"{out}: read it, and complete the items marked as to be written by you", err=True)


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
