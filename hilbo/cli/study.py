"""The commands of a whole study: `hilbo validate`, `hilbo power` and `hilbo report`."""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hilbo.cli.terminal.console import (
    Force,
    Json,
    OneMaterial,
    Out,
    Preset,
    finish,
    progress,
    results,
    seed_option,
    start,
)
from hilbo.errors import InputError

if TYPE_CHECKING:
    from hilbo.study.config import Study

__all__ = ["power", "report", "simulated_report", "validate"]

StudyFile = Annotated[Path, typer.Option("--study", help="Study file (TOML).")]


def validate(
    responses: Annotated[Path, typer.Argument(help="Validation table (CSV or Parquet).", show_default=False)],
    study: StudyFile,
    out: Out = Path("validation"),
    sets: Annotated[Path | None, typer.Option(help="Sets table: parameters and source of each set.")] = None,
    material: Annotated[str | None, typer.Option(help="Use only this material of the table.")] = None,
    seed: Annotated[int, seed_option("of bootstrap resamples")] = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Analyse validation sessions: confusion matrix, preferences, and the paper's tables II to IV.

    Writes result.json, tables, figures and report.html to the folder --out.
    """
    with results(out, force) as folder, progress() as say:
        start()
        from hilbo.report.validation import write_validation
        from hilbo.study.config import Study

        content = write_validation(Study.load(study), responses, sets, material, folder, seed, say)
    finish(content, out, as_json)


def power(
    study: Annotated[Path, typer.Argument(help="Study file (TOML).", show_default=False)],
    out: Out = Path("power"),
    preset: Preset = None,
    rule: Annotated[str | None, typer.Option(help="Aggregation method in place of the study file's.")] = None,
    material: OneMaterial = None,
    participants: Annotated[
        str, typer.Option(help="Number of participants; several numbers separated by commas.")
    ] = "6,12,24",
    trials: Annotated[
        str, typer.Option(help="Number of trials per participant; several numbers separated by commas.")
    ] = "10,15,20,25",
    error: Annotated[
        float, typer.Option(min=0, max=1, help="Target error of the optimum (NRMSE, fraction of the ranges).")
    ] = 0.15,
    studies: Annotated[int, typer.Option(min=2, help="Number of simulated studies.")] = 40,
    jobs: Annotated[int | None, typer.Option(min=1, help="Processes; by default one for each core.")] = None,
    seed: Annotated[int, seed_option("of the simulated studies")] = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Find how many participants and trials are enough for a given error of the optimum, by simulated studies.

    Writes result.json, a table, figures and report.html to the folder --out; after Ctrl-C those of the finished
    studies, if there are two.
    """
    begun = time.perf_counter()
    with results(out, force) as folder, progress() as say:
        start()
        from hilbo.report.power import write_power
        from hilbo.simulation.power import Plan, cores, simulate_power
        from hilbo.simulation.presets import population_of
        from hilbo.study.config import Study
        from hilbo.study.estimate.learnt import by_rule

        whole = Study.load(study)
        material = material or _only_material(whole)
        chosen = whole.material(material) if material else whole
        chosen = chosen if rule is None else by_rule(chosen, rule)
        name, population = population_of(chosen, preset)
        plan = Plan(_numbers(participants, "--participants"), _numbers(trials, "--trials"), studies, seed)
        jobs = min(jobs or cores(), studies)
        say(f"simulating {studies} studies in {jobs} processes")
        count = partial(say, "designs of simulated studies")
        errors = simulate_power(chosen, population, plan, jobs=jobs, begin=start, say=count)
        finished = errors["study"].nunique()
        if finished < studies:
            say.tell([f"Interrupted: the results are of the {finished} of {studies} studies that were finished."])
            plan = replace(plan, studies=finished)
        cost = {
            "seconds": time.perf_counter() - begun,
            "jobs": jobs,
            "cores": cores(),
            "preset": name,
            "material": material,
        }
        content = write_power(chosen, errors, plan, error, cost, folder)
    finish(content, out, as_json)


def _only_material(study: "Study") -> str | None:
    """Name of the only material of a study; None if it has none. Raises `InputError` if it has several."""
    named = study.file.materials
    if len(named) > 1:
        raise InputError(f"power: the study has several materials ({', '.join(named)}); choose one with --material.")
    return named[0] if named else None


def _numbers(text: str, option: str) -> tuple[int, ...]:
    """Whole numbers from a text in which commas separate them, sorted. Raises `InputError`, which names the option."""
    try:
        return tuple(sorted(int(number) for number in text.split(",")))
    except ValueError:
        raise InputError(f'{option} is "{text}"; write whole numbers separated by commas, as in 6,12,24.') from None


def report(
    folder: Annotated[Path, typer.Argument(help="Folder with study.toml and trials.csv.", show_default=False)],
    out: Out = Path("report"),
    exclude: Annotated[
        str | None, typer.Option(help='Rule for excluding participants, instead of the study\'s: "trials < 10".')
    ] = None,
    compare: Annotated[bool, typer.Option(help="Compare all aggregation methods by cross-validation.")] = True,
    people: Annotated[
        Path | None, typer.Option(help="participants.csv: the page describes ages and handedness; no row is copied.")
    ] = None,
    seed: Annotated[int, seed_option("of bootstrap resamples and of the candidate points of the optima")] = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Write the whole results section of a folder of sessions: one page, figures and tables, in the paper's order.

    They go to the folder --out.
    """
    if out.resolve() in (folder.resolve(), *folder.resolve().parents):
        raise InputError(f"{out}: contains the folder that is read; choose another --out.")
    with results(out, force) as destination, progress() as say:
        start()
        say("reading")
        from hilbo.report.study.report import write_study
        from hilbo.session.plan.participants import read_people
        from hilbo.study.folder import read_folder

        listed = None if people is None else read_people(people)
        content = write_study(
            read_folder(folder, exclude), destination, seed, say, comparison=compare, people=listed, count=say
        )
    finish(content, out, as_json)


def simulated_report(folder: Path, seed: int, say: Callable[..., None], count: int = 24) -> dict[str, Any]:
    """Simulate a study of the paper's kind, with its validation sessions, into `folder`, as `hilbo report` reads it,
    write its report there too, and return the content of result.json. `count`: number of participants."""
    import numpy as np

    from hilbo.report.study.report import write_study
    from hilbo.simulation.folder import simulate_folder
    from hilbo.simulation.validation_sessions import sets_table, validation_table
    from hilbo.study.analysis.analysis import analyse
    from hilbo.study.folder import read_folder

    say("simulating")
    (simulated,) = simulate_folder(folder, "paper", count, seed)
    (material,) = read_folder(folder).materials
    analysis = analyse(material.study, material.cohort, seed, say, count=say)
    if analysis.sets is not None:
        say("simulated validation sessions")
        individual_optima = np.asarray(analysis.aggregate.individuals.x)
        sets = sets_table(simulated.study, analysis.sets, individual_optima)
        sets.to_csv(folder / "sets.csv", index=False)
        judged = validation_table(simulated.study, simulated.population, sets, seed=seed)
        judged.to_csv(folder / "validation.csv", index=False)
    return write_study(read_folder(folder), folder, seed, say, {material.name: analysis}, comparison=False)
