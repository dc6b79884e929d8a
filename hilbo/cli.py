"""The command line: `hilbo aggregate | simulate | robustness | demo`; the only place that parses arguments.

Results go to a folder, machine-readable ones with `--json` to stdout, progress to stderr. Exit code 0: done, 1: failed,
2: bad usage or bad input, said in one sentence. A folder is written beside its final place and moved there when it is
complete, so that a failure leaves nothing behind and nothing is overwritten without `--force`.
"""

import contextlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from hilbo.errors import InputError

__all__ = ["app", "main"]

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="From people's ordinal answers to a population optimum, for haptic rendering of viscoelastic material.",
)

StudyOption = Annotated[Path, typer.Option("--study", help="Study file (TOML).")]
Out = Annotated[Path, typer.Option("--out", help="Folder for the results.")]
Seed = Annotated[int, typer.Option("--seed", help="Decides candidates, and in simulations everything random.")]
Force = Annotated[bool, typer.Option("--force", help="Replace an existing results folder.")]
Json = Annotated[bool, typer.Option("--json", help="Print result.json on stdout.")]
Table = Annotated[Path, typer.Argument(help="Trial table (CSV or Parquet).", show_default=False)]


# What the commands write: a folder with anything else in it is never replaced.
_FIGURES = ("map", "progress", "slices", "optima", "maps", "moves")
_PARTS = ("video-quality", "simulated-memory-foam")
_WRITTEN = {"result.json", "report.html", "map.nc", "optima.csv", "trials.csv", "truth.csv", "study.toml", *_PARTS} | {
    f"{figure}.{kind}" for figure in _FIGURES for kind in ("png", "svg")
}


def main() -> None:
    """Entry point: runs a command, and turns bad input into one sentence and exit code 2."""
    try:
        app()
    except InputError as error:
        _fail(str(error), 2)
    except (OSError, RuntimeError) as error:
        _fail(f"{type(error).__name__}: {error}", 1)


@app.command()
def aggregate(
    trials: Table,
    study: StudyOption,
    out: Out,
    seed: Seed = 0,
    material: Annotated[str | None, typer.Option(help="Which of the table's materials.")] = None,
    participants: Annotated[str | None, typer.Option(help="Only these, separated by commas.")] = None,
    first: Annotated[int | None, typer.Option(min=1, help="Only everybody's first so many trials.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Merge people's answers into one population map and find its optimum."""
    with _results(out, force) as folder, _progress() as say:
        chosen, cohort = _read(trials, study, material, say)
        cohort = cohort.of(participants.split(",")) if participants else cohort
        cohort = cohort.first(first) if first else cohort
        content = _aggregate(chosen, cohort, folder, seed, say)
    _finish(content, out, as_json)


@app.command()
def simulate(
    out: Out,
    preset: Annotated[str, typer.Option(help="Population that the people are drawn from.")] = "paper",
    study: Annotated[Path | None, typer.Option("--study", help="Study file; by default the preset's own.")] = None,
    participants: Annotated[int, typer.Option(min=1, help="How many people.")] = 24,
    seed: Seed = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Simulate a study whose truth is known, and aggregate it."""
    with _results(out, force) as folder, _progress() as say:
        content = _simulate(preset, study, participants, seed, folder, say)
    _finish(content, out, as_json)


@app.command()
def robustness(
    trials: Table,
    study: StudyOption,
    out: Out,
    seed: Seed = 0,
    own: Annotated[
        bool, typer.Option("--own", help="Each person's own hyperparameters instead of shared ones.")
    ] = False,
    learn: Annotated[
        str, typer.Option(help="What the evidence chooses, separated by commas.")
    ] = "theta,noise,thresholds",
    material: Annotated[str | None, typer.Option(help="Which of the table's materials.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Do the optima stay where they are when the evidence chooses the hyperparameters?"""
    with _results(out, force) as folder, _progress() as say:
        chosen, cohort = _read(trials, study, material, say)
        from hilbo.report_robustness import write_robustness
        from hilbo.robustness import robustness as check

        say("hyperparameters by maximum evidence")
        found = check(chosen, cohort, seed, learn=tuple(learn.split(",")), shared=not own)
        say("maps, figures and report")
        content = write_robustness(chosen, cohort, found, folder, seed)
    _finish(content, out, as_json)


@app.command()
def demo(out: Out = Path("demo-results"), seed: Seed = 0, force: Force = False) -> None:
    """Real people's answers, then a simulated haptic study of known truth: two results folders to look at."""
    from importlib.resources import files

    data = files("hilbo") / "data"
    with _results(out, force) as folder, _progress() as say:
        for part in _PARTS:
            (folder / part).mkdir()
        chosen, cohort = _read(Path(str(data / "video_quality.csv")), Path(str(data / "video_quality.toml")), None, say)
        real = _aggregate(chosen, cohort, folder / _PARTS[0], seed, say)
        simulated = _simulate("paper", None, 24, seed, folder / _PARTS[1], say)
    _print_demo(real, simulated, out)


def _start() -> None:
    """Float64, and compiled functions kept in the user's cache folder from one command to the next."""
    import jax

    jax.config.update("jax_enable_x64", True)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(Path(home) / "hilbo" / "jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def _read(trials, study, material, say):
    say("reading")
    _start()
    from hilbo.config import Study
    from hilbo.study import cohort_of
    from hilbo.tables import read_trials

    chosen = Study.load(study)
    chosen = chosen.material(material) if material and chosen.materials else chosen
    return chosen, cohort_of(read_trials(trials, chosen, material), chosen)


def _aggregate(study, cohort, folder, seed, say, truth=None) -> dict[str, Any]:
    from hilbo import report
    from hilbo.study import aggregate_cohort

    say(f"fitting {len(cohort.names)} participants ({study.name})")
    found = aggregate_cohort(study, cohort, seed)
    return report.write_results(study, found, folder, seed, truth, say)


def _simulate(preset, study, count, seed, folder, say) -> dict[str, Any]:
    say("simulating")
    _start()
    from importlib.resources import files

    import numpy as np

    from hilbo import simulate as simulation
    from hilbo.config import Study
    from hilbo.study import cohort_of
    from hilbo.tables import write_trials

    if preset not in simulation.PRESETS:
        raise InputError(f'--preset is "{preset}"; there are {", ".join(simulation.PRESETS)}.')
    population = simulation.PRESETS[preset]
    source = Path(str(files("hilbo") / "data" / f"{preset}.toml")) if study is None else study
    chosen = Study.load(source)
    people = simulation.people(chosen, population, count, seed)
    trials = simulation.simulate_study(chosen, people, seed)
    table = simulation.to_table(chosen, trials)
    write_trials(table, folder / "trials.csv")
    write_trials(simulation.truth_table(chosen, population, people), folder / "truth.csv")
    shutil.copyfile(source, folder / "study.toml")
    truth = np.asarray(chosen.space.to_unit(np.array([population.truth[name] for name in chosen.space.names])))
    table["category"] = table["response"].map({label: i for i, label in enumerate(chosen.responses)})
    return _aggregate(chosen, cohort_of(table, chosen), folder, seed, say, truth)


@contextlib.contextmanager
def _results(out: Path, force: bool) -> Iterator[Path]:
    """A new folder that becomes `out` when everything in it is complete."""
    out = out.resolve()
    _check_free(out, force)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}); choose another --out.") from error
    try:
        yield made
        made.chmod(0o755)
        if out.exists():
            shutil.rmtree(out)
        made.rename(out)
    finally:
        shutil.rmtree(made, ignore_errors=True)


def _check_free(out: Path, force: bool) -> None:
    """Refuse to replace anything without `force`, and with it anything that is not hilbo's."""
    if not out.exists():
        return
    if not out.is_dir():
        raise InputError(f"{out}: is a file; choose a folder for --out.")
    if any(out.iterdir()) and not force:
        raise InputError(f"{out}: exists already; choose another --out, or add --force to replace it.")
    foreign = next((path for path in out.rglob("*") if path.name not in _WRITTEN), None)
    if foreign is not None:
        raise InputError(f"{foreign}: is not a result of hilbo's; choose another --out, so that it is not lost.")


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[str], None]]:
    """Says on stderr what is being done: in one changing line on a terminal, else in a line for each thing."""
    from rich.console import Console

    console, begun = Console(stderr=True, highlight=False, markup=False, soft_wrap=True), time.perf_counter()
    with console.status("starting") as status:

        def say(text: str) -> None:
            if console.is_terminal:
                status.update(text)
            else:
                console.print(text)

        yield say
    console.print(f"done in {time.perf_counter() - begun:.1f} s")


def _finish(content, out, as_json):
    from hilbo.report import as_json as text

    for warning in content.get("warnings", []):
        print(f"hilbo: {warning}", file=sys.stderr)
    if as_json:
        print(text(content), end="")
    else:
        print(f"{out / 'report.html'}", file=sys.stderr)


def _fail(sentence: str, code: int) -> None:
    print(f"hilbo: {sentence}", file=sys.stderr)
    sys.exit(code)


def _print_demo(real, simulated, out) -> None:
    """The demo's last words: the real optimum in a line, the simulated misses beside the paper's."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as RichTable

    console = Console(highlight=False, soft_wrap=True)
    best = real["optimum"]["parameters"]
    console.print(f"\nVideo quality, {len(real['participants'])} people: the map is highest at", end=" ")
    console.print(", ".join(f"{name} = {value:.0f}" for name, value in best.items()) + ".\n")
    truth = simulated["truth"]
    table = RichTable(
        title="Simulated memory foam, 24 people x 25 trials: NRMSE to the truth, of the search ranges",
        box=box.SIMPLE_HEAD,
        title_justify="left",
        pad_edge=False,
    )
    for head in ("", "K1, B1, alpha", "with K0", "passive by", "the paper"):
        table.add_column(head, justify="right" if head else "left", no_wrap=True)

    def row(name, key, found, paper):
        miss, margin = truth["nrmse"][key], found["passivity_margin"]
        passive = f"{'yes' if margin >= 0 else 'no'}, {margin:+.3f}"
        table.add_row(name, f"{100 * miss['nrmse']:.1f} %", f"{100 * miss['nrmse_with_K0']:.1f} %", passive, paper)

    row("population (BCM)", "aggregate", simulated["optimum"], "4 %, yes")
    q, qk = truth["individuals"]["quartiles"], truth["individuals"]["with_K0"]
    spread = [f"{100 * v[1]:.0f} % ({100 * v[0]:.0f}–{100 * v[2]:.0f})" for v in (q, qk)]
    margins = [person["optimum"]["passivity_margin"] for person in simulated["participants"]]
    passive = f"{sum(margin >= 0 for margin in margins)} of {len(margins)}"
    table.add_row("individuals", *spread, passive, "24 % (13–41)")
    row("mean of optima", "mean_of_optima", simulated["mean_of_optima"], "10.5 %, no")
    row("mean of maps", "average", simulated["alternatives"]["average"], "")
    console.print(table)
    console.print("Individuals: median and quartiles. Passive by so many N.s/m of damping more than the least.")
    top = truth["top_answers"]
    console.print(f'"close" answers of 25: {top["mean"]:.2f} ± {top["sd"]:.2f} (paper: 5.96 ± 4.47)\n')
    for part in _PARTS:
        console.print(str(out / part / "report.html"))
