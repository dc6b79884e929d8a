"""`hilbo simulate`: a study whose truth is known, or one session without people."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hilbo.cli.aggregate import aggregate_cohort
from hilbo.cli.live import live as hold_session
from hilbo.cli.terminal.console import (
    Force,
    Json,
    Out,
    Preset,
    Say,
    finish,
    progress,
    results,
    seed_option,
    start,
)
from hilbo.errors import InputError

if TYPE_CHECKING:
    from hilbo.simulation.folder import Simulated

__all__ = ["simulate"]

_PEOPLE = 24


def simulate(
    out: Out = Path("simulated"),
    preset: Preset = None,
    study: Annotated[Path | None, typer.Option("--study", help="Study file (TOML); by default the paper's.")] = None,
    participants: Annotated[int | None, typer.Option(min=1, help="Number of participants; by default 24.")] = None,
    seed: Annotated[
        int, seed_option("of the participants, of their responses and of the candidate points of the optima")
    ] = 0,
    force: Force = False,
    as_json: Json = False,
    live: Annotated[
        bool, typer.Option("--live", help="Run one live session instead: real server, pages and simulated device.")
    ] = False,
    kind: Annotated[
        str | None,
        typer.Option(help="With --live: optimisation, validation or aggregate-best; by default optimisation."),
    ] = None,
    step_seconds: Annotated[
        float | None, typer.Option(min=0.05, help="With --live: duration of every step, s; by default the study's.")
    ] = None,
) -> None:
    """Simulate a study of known truth and aggregate it; with --live, run one session with a simulated participant.

    Writes the simulated trials and their results, of each material to a folder of its name, or the session's log and
    screenshots, to the folder --out.
    """
    _check_mode(
        live, {"--participants": participants, "--force": force}, {"--kind": kind, "--step-seconds": step_seconds}
    )
    if live:
        _simulate_live(preset, study, out, kind or "optimisation", step_seconds, seed, as_json)
        return
    with results(out, force) as folder, progress() as say:
        contents = _simulate(preset, study, participants or _PEOPLE, seed, folder, say)
    for name, content in contents.items():
        finish(content, out / name, as_json and not name, say.printed)
    if as_json and "" not in contents:
        written = ((name, (out / name / "result.json").read_text(encoding="utf-8")) for name in contents)
        print(f'{{"materials": {{{", ".join(f"{json.dumps(name)}: {text}" for name, text in written)}}}}}')


def _check_mode(live: bool, of_a_study: Mapping[str, Any], of_a_session: Mapping[str, Any]) -> None:
    """Raise `InputError` for an option that would be ignored: with `live` one of a study, without it one of a session.
    Both map names of options to values; one without a value was not given."""
    if live and (given := [name for name, value in of_a_study.items() if value]):
        raise InputError(f"{given[0]} does nothing with --live, which runs one session in a new folder; leave it out.")
    if not live and (given := [name for name, value in of_a_session.items() if value]):
        raise InputError(f"{given[0]} does nothing without --live; add --live, or leave it out.")


def _simulate(
    preset: str | None, source: Path | None, count: int, seed: int, folder: Path, say: Say
) -> dict[str, dict[str, Any]]:
    """Simulate `count` participants of the study file `source` (None: the paper's), write their trials to `folder`, and
    each material's results there, or to a folder named after it. Returns that folder's name ("" without materials) ->
    content of result.json."""
    say("simulating")
    start()
    from hilbo.report.validation import folder_names
    from hilbo.simulation.folder import simulate_folder

    contents = {}
    every = simulate_folder(folder, preset, count, seed, source)
    names = folder_names([simulated.material for simulated in every])
    for simulated in every:
        name = names[simulated.material] if simulated.material else ""
        if name:
            say(simulated.material)
            (folder / name).mkdir()
        contents[name] = _aggregated(simulated, folder / name, seed, say)
    return contents


def _aggregated(simulated: "Simulated", folder: Path, seed: int, say: Say) -> dict[str, Any]:
    """Aggregate the simulated responses to one material into `folder`, and return the content of result.json. The error
    of the optimum is printed, if one stimulus is the best."""
    from hilbo.report.registration import selection_words
    from hilbo.study.estimate.location import truth_sentence

    study = simulated.study
    truth, chosen = simulated.truth if study.one_optimum else None, selection_words(study.file.selection)
    content = aggregate_cohort(study, simulated.cohort, folder, seed, say, truth, selection=chosen)
    if truth is not None:
        say.tell([truth_sentence(study, truth, content["truth"]["nrmse"]["aggregate"]["nrmse"])])
    return content


def _simulate_live(
    preset: str | None, study: Path | None, out: Path, phase: str, seconds: float | None, seed: int, as_json: bool
) -> None:
    """Run one session without people into the folder `out`, and print its summary on stdout."""
    from importlib.resources import files

    source = Path(str(files("hilbo") / "data" / "paper.toml")) if study is None else study
    with progress() as say:
        summary = hold_session(source, out, preset, phase, seconds, seed, say)
    print(
        json.dumps(summary, indent=2) if as_json else f"{summary['answers']} answers in {summary['seconds']} s: {out}"
    )
