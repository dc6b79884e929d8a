"""The commands `hilbo aggregate` and `hilbo robustness`, and what they share with others: a cohort read, a results
folder written."""

import contextlib
import importlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hilbo.cli.terminal.console import (
    Force,
    Json,
    Names,
    OneMaterial,
    Out,
    Say,
    finish,
    progress,
    remark,
    results,
    seed_option,
    start,
)
from hilbo.errors import InputError, warn_caller
from hilbo.population.rules.registry import GIVEN, RECIPES
from hilbo.report.figures.painter import begin_painter

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr

    from hilbo.study.analysis.cohort_results import CohortResults
    from hilbo.study.cohort import Cohort
    from hilbo.study.config import Study
    from hilbo.study.estimate.distributed import Crew
    from hilbo.study.formats.json_file import Content

__all__ = ["aggregate", "aggregate_cohort", "read_cohort", "robustness"]

# Modules for figures and files, loaded during the arithmetic. Packages that the arithmetic never imports, because two
# threads that import one package at once may see half of it.
_DRAW_AND_WRITE = ("matplotlib.figure", "matplotlib.backends.backend_svg", "jinja2")

StudyOption = Annotated[Path, typer.Option("--study", help="Study file (TOML).")]
Table = Annotated[
    Path, typer.Argument(help="Trial table (CSV or Parquet), or a folder of session logs.", show_default=False)
]


def aggregate(
    trials: Table,
    study: StudyOption,
    out: Out = Path("results"),
    seed: Annotated[int, seed_option("of the candidate points of the optimum")] = 0,
    material: OneMaterial = None,
    names: Names = None,
    first: Annotated[int | None, typer.Option(min=1, help="Use only the first N trials of each participant.")] = None,
    individuals: Annotated[
        bool, typer.Option(help="Also compute each participant's own optimum (the slowest step).")
    ] = True,
    rule: Annotated[
        str | None,
        typer.Option(
            help=f"Aggregation method in place of the study file's: {', '.join(GIVEN)}, or"
            f" {' and '.join(RECIPES)}, which learn [gp] too."
        ),
    ] = None,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="Also compare all methods by cross-validation; writes comparison.json, comparison.csv, figures.",
        ),
    ] = False,
    cores: Annotated[
        int | None, typer.Option(min=1, help="Number of CPU cores to distribute participants over.")
    ] = None,
    distributed: Annotated[
        bool,
        typer.Option("--distributed", help="Run as one of several processes (srun, mpirun, or --coordinator ...)."),
    ] = False,
    coordinator: Annotated[
        str | None, typer.Option(envvar="JAX_COORDINATOR_ADDRESS", help="HOST:PORT of process 0.")
    ] = None,
    processes: Annotated[
        int | None, typer.Option(min=1, envvar="JAX_NUM_PROCESSES", help="Number of processes.")
    ] = None,
    process_id: Annotated[
        int | None, typer.Option(min=0, envvar="JAX_PROCESS_ID", help="Index of this process (0-based).")
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Aggregate participants' responses into one population map and find its optimum.

    Writes result.json, tables, figures and report.html to the folder --out.
    """
    if not distributed:
        begin_painter()
    start(cores)
    import jax

    from hilbo.study.estimate.distributed import crew, digest
    from hilbo.study.estimate.learnt import by_rule

    content: Content = {}
    with crew(distributed, coordinator, processes, process_id) as team, contextlib.ExitStack() as held:
        say = held.enter_context(progress(quiet=not team.writes))
        with team.agreement() as agree:
            folder = held.enter_context(results(out, force)) if team.writes else None
            chosen, cohort, flagged = read_cohort(trials, study, material, say)
            cohort = _chosen(cohort, names) if names else cohort
            cohort, left_out = _included(chosen, cohort, say)  # by the study's model, for any --rule
            left_out = [*flagged, *left_out]
            chosen = chosen if rule is None else by_rule(chosen, rule)
            cohort = cohort.first(first) if first else cohort
            agree(digest(chosen.file.content, chosen.rule, seed, individuals, cohort))
            whole = _whole(len(cohort.names), jax.device_count(), individuals, compare)
        if whole:
            population, grid = _analysed(chosen, cohort, seed, say), None
        else:
            population, grid = _analysed_together(chosen, cohort, seed, say, team, individuals)
        if folder is not None:
            content = _written(population, folder, say, compare=compare, left_out=left_out, grid=grid)
    if team.writes:
        finish(content, out, as_json, say.printed)


def robustness(
    trials: Table,
    study: StudyOption,
    out: Out = Path("robustness"),
    seed: Annotated[int, seed_option("of the candidate points of the optima")] = 0,
    learn: Annotated[
        str, typer.Option(help="Hyperparameters to optimise, separated by commas; learnt-1 to learnt-3 optimise all.")
    ] = "theta,noise,thresholds",
    material: OneMaterial = None,
    pilot: Annotated[
        bool,
        typer.Option("--pilot", help="Print the optimised hyperparameters as [gp], with 95 % intervals, for a study."),
    ] = False,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Compare the optima with those under hyperparameters that maximise the evidence.

    Writes result.json, tables, figures and report.html to the folder --out.
    """
    with results(out, force) as folder, progress() as say:
        chosen, everybody, flagged = read_cohort(trials, study, material, say)
        cohort, left_out = _included(chosen, everybody, say)
        from hilbo.report.robustness import gp_table, write_robustness
        from hilbo.study.robustness import pilot as pilots
        from hilbo.study.robustness.robustness import robustness as check

        if pilot:
            pilots.check_pilot(chosen, cohort)
        say("optimising the hyperparameters (maximum evidence)")
        comparison = check(chosen, cohort, seed, learn=tuple(name.strip() for name in learn.split(",")))
        sure = pilots.pilot(chosen, cohort, comparison.hyperparameters, say) if pilot else None
        say("computing maps, drawing figures and writing the report")
        content = write_robustness(chosen, cohort, comparison, folder, seed, [*flagged, *left_out], sure)
    finish(content, out, as_json, say.printed)
    if pilot and not as_json:
        print(gp_table(content))


def read_cohort(trials: Path, study: Path, material: str | None, say: Any) -> tuple[Any, Any, list[str]]:
    """Load a study and its trial table, or a folder of session logs. Returns the study of the one `material` (None: the
    only one in the table), its cohort, and sentences on the trials that are left out because of the device's flags, and
    on missing responses. Calls `start`, and prints remarks on stderr; `say` is told of progress. Raises `InputError`.
    """
    say("reading")
    start()
    from hilbo.study.cohort import cohort_of
    from hilbo.study.config import Study
    from hilbo.study.formats.csv_file import cell_pieces
    from hilbo.study.tables.flag_counts import flag_sentences_of
    from hilbo.study.tables.trials import trial_table

    whole = Study.load(study)
    if trials.is_dir():
        from hilbo.session.export.tables import log_cells

        pieces, note, note_rows = log_cells(trials, whole.file, remark), remark, lambda rows: None
    else:
        pieces, note, note_rows = cell_pieces(trials), warn_caller, lambda rows: say("rows read", rows)
    if whole.file.materials and material is None:
        pieces = list(pieces)
        material = _only_material(pieces, trials)
    chosen = whole.material(material) if material and whole.file.materials else whole
    table = trial_table(pieces, chosen.file, material, source=str(trials), others=False, say=note_rows, note=note)
    missing = [f"{trials}: {sentence}" for sentence in table.missing.sentences]
    if missing:
        say.printed += missing  # by `note`
    return chosen, cohort_of(table, chosen), [*flag_sentences_of(table.flags, chosen.file.exclude_flags), *missing]


def _only_material(pieces: list[Any], source: Path) -> str | None:
    """The only material named in the cells of a table; None, with a remark on stderr, if they name none. Raises
    `InputError` if they name several."""
    named = list(dict.fromkeys(name for cells in pieces if "material" in cells for name in cells["material"]))
    if len(named) > 1:
        raise InputError(f"{source}: contains {len(named)} materials ({', '.join(named)}); choose one with --material.")
    if not named:
        remark(f"{source}: names no material; it is read by the study's own tables, and none of [materials].")
    return named[0] if named else None


def _chosen(cohort: Any, participants: str) -> Any:
    """The cohort of the participants named, separated by commas, in the order of the table. Raises `InputError` for one
    that is not in it, or named twice."""
    some = cohort.of([name.strip() for name in participants.split(",")])
    return some.of([name for name in cohort.names if name in set(some.names)])


def _included(study, everybody, say: Say) -> tuple[Any, list[str]]:
    """The cohort without the participants whom the study's rule of exclusion leaves out, and sentences on them, which
    are also printed on stderr, and noted as printed in `say`. Raises `InputError` if none is left."""
    if not study.file.exclude:
        return everybody, []
    from hilbo.study.exclusion import exclusion_sentences, included

    cohort, _, left_out = included(study, everybody)
    sentences = exclusion_sentences(study, left_out)
    for sentence in sentences:
        remark(sentence)
    say.printed += sentences
    return cohort, sentences


def _whole(people: int, devices: int, individuals: bool, compare: bool) -> bool:
    """Whether all analyses are computed, that is also maps by other rules, the optima after fewer trials, the region of
    the optimum and the model check: with individual optima, for up to `MANY` participants on one device.

    Raises `InputError` if `compare` is asked for without them.
    """
    from hilbo.study.estimate.aggregate import MANY

    whole = individuals and people <= MANY and devices == 1
    if compare and not whole:
        raise InputError(f"--compare is for up to {MANY:,} people on one device, with their own optima.")
    return whole


def aggregate_cohort(
    study: "Study",
    cohort: "Cohort",
    folder: Path,
    seed: int,
    say: Say,
    truth: "np.ndarray | None" = None,
    selection: str = "",
) -> "Content":
    """Analyse a cohort, write its results to `folder`, and return the content of result.json. `truth` (d,): the true
    optimum of a simulation; `selection`: how trials were chosen, in words, for the report."""
    return _written(_analysed(study, cohort, seed, say), folder, say, truth=truth, selection=selection)


def _analysed(
    study: "Study", cohort: "Cohort", seed: int, say: Say, *, whole: bool = True, individuals: bool = True
) -> "CohortResults":
    """Fit and analyse a cohort; the first results are printed as soon as they are known, and what draws and writes is
    imported in a thread meanwhile. `whole`: see `_whole`; `individuals`: compute individual optima too."""
    from hilbo.study.analysis.cohort_results import analyse_cohort

    with ThreadPoolExecutor(1) as other_core:

        def report_early(sentences):
            say.tell(sentences)
            other_core.submit(list, map(importlib.import_module, _DRAW_AND_WRITE))

        return analyse_cohort(study, cohort, seed, say, report_early, whole=whole, individuals=individuals, count=say)


def _analysed_together(
    study: "Study", cohort: "Cohort", seed: int, say: Say, team: "Crew", individuals: bool
) -> "tuple[CohortResults, xr.Dataset]":
    """Fit a cohort on all devices of all processes, without the analyses that `_whole` decides on: the results, as
    arrays of this process, and the population map on a grid."""
    from hilbo.numerics.sharding import host_local
    from hilbo.report.results import population_grid

    with team.sharded():
        population = _analysed(study, cohort, seed, say, whole=False, individuals=individuals)
        say("computing the population map on a grid")
        grid = population_grid(population)
    return host_local(population), grid


def _written(
    population: "CohortResults",
    folder: Path,
    say: Say,
    *,
    truth: "np.ndarray | None" = None,
    compare: bool = False,
    selection: str = "",
    left_out: Sequence[str] = (),
    grid: "xr.Dataset | None" = None,
) -> "Content":
    """Write the results folder of a cohort, and return the content of result.json. `compare`: compare all aggregation
    methods too, leaving out one participant at a time; `left_out`: sentences on excluded participants or trials;
    `grid`: the population map on a grid, computed here if None; `truth`, `selection`: see `aggregate_cohort`."""
    from hilbo.report.results import write_results

    study, beside = population.study, {}
    if compare:
        from hilbo.report.study.comparison import write_comparison
        from hilbo.study.analysis.rule_comparison import compare as compare_rules

        say("cross-validating all methods (leave-one-participant-out)")
        rules = compare_rules(study, population.aggregate, population.seed)
        compared = write_comparison(study, population.aggregate, rules, folder)
        beside = {"comparison": compared.section, "pictures": compared.pictures}
    shown = {"left_out": left_out, "selection": selection, "grid": grid} | beside
    return write_results(population, folder, truth, say, **shown)
