"""The commands on materials, `hilbo identify` and `hilbo passivity`."""

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from hilbo.cli.terminal.console import Force, Json, Out, check_choice, finish, progress, results, seed_option, start
from hilbo.errors import InputError

__all__ = ["identify", "passivity"]

Taps = Annotated[int, typer.Option("--N", min=1, help="Past samples of the model.")]
Period = Annotated[float, typer.Option("--T", help="Sampling time of the model, s.")]
Memory = Annotated[str, typer.Option(help='"short" (N samples) or "full".')]


def identify(
    table: Annotated[Path, typer.Argument(help="Creep and relaxation tests (CSV, text, Parquet).", show_default=False)],
    out: Out = Path("material"),
    material: Annotated[
        str | None, typer.Option(help="Which of the table's materials, or its name if the table has no column for it.")
    ] = None,
    taps: Taps = 101,
    period: Period = 1e-3,
    memory: Memory = "short",
    damping: Annotated[float | None, typer.Option(help="Damping of the device, N.s/m.")] = None,
    only: Annotated[str | None, typer.Option(help="Fit one kind of test alone: relaxation or creep.")] = None,
    begin: Annotated[str, typer.Option(help='Tests begin at "rest" or in "equilibrium" with the first row.')] = "rest",
    lag: Annotated[str, typer.Option(help='Lag of the force against the position, ms; or "fit".')] = "fit",
    corner: Annotated[
        str,
        typer.Option(
            help='Corner of the force\'s filter, Hz; "fit", "none", or "auto" (fit with a fitted lag where it shows).'
        ),
    ] = "auto",
    compare_memory: Annotated[bool, typer.Option(help="Refit with other numbers of past samples.")] = True,
    model: Annotated[str, typer.Option(help='For moduli: "fosls" or "fractional-maxwell".')] = "fosls",
    weights: Annotated[str | None, typer.Option(help='For moduli: residuals over the "range", or "relative".')] = None,
    longest: Annotated[float | None, typer.Option(help="Use only the first seconds of each test, s.")] = None,
    test: Annotated[
        str | None, typer.Option(help='Kind of test of a table without a column "test": relaxation or creep.')
    ] = None,
    column: Annotated[
        list[str] | None,
        typer.Option(
            help='Which column is a quantity, as "force_N=Load"; "force_N=-Load" changes its sign. Repeatable.'
        ),
    ] = None,
    block: Annotated[
        list[int] | None, typer.Option(help="Number of the block to read from a file of several. Repeatable.")
    ] = None,
    area: Annotated[float | None, typer.Option(help="Area of the sample, mm2, for stress and strain.")] = None,
    gap: Annotated[float | None, typer.Option(help="Thickness of the sample, mm, for stress and strain.")] = None,
    seed: Annotated[int, seed_option("of bootstrap resamples")] = 0,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Find the parameters of a material from creep and relaxation tests, or from moduli.

    Writes result.json, figures and report.html to the folder --out, for tests with a force also the [renderer] block of
    a study file and sets.csv, the reference of a report.
    """
    check_choice("memory", memory, ("short", "full"))
    check_choice("begin", begin, ("rest", "equilibrium"))
    check_choice("model", model, ("fosls", "fractional-maxwell"))
    check_choice("weights", weights, (None, "range", "relative"))
    _positive("T", period)
    _positive("damping", damping)
    _positive("longest", longest)
    _positive("area", area)
    _positive("gap", gap)
    check_choice("test", test, (None, "relaxation", "creep"))
    instrument = {"lag": _number("lag", lag, ("fit",)), "corner": _number("corner", corner, ("fit", "none", "auto"))}
    with results(out, force) as folder, progress() as say:
        say("reading")
        start()
        from hilbo.identification import characterise, memory_selection
        from hilbo.identification.fitting import MEASURED
        from hilbo.identification.material_tables import read_material
        from hilbo.identification.tables.layout import Layout
        from hilbo.report import material as report_material

        layout = Layout(test, tuple(block or ()), tuple(column or ()), area, gap)
        measurements = read_material(table, material, begin=begin, only=only, longest=longest, layout=layout)
        measured = measurements.tests[0].kind in MEASURED
        chosen = _model(measured, model, weights, taps, period, memory, instrument)
        choices = memory_selection.CHOICES if measured and compare_memory else ()
        try:
            result = characterise.characterise(
                measurements.tests, chosen, seed, choices, say, find_filter=instrument["corner"] == "auto"
            )
        except InputError as error:
            raise InputError(f"{table}: {error}") from None
        say("drawing figures and writing the report")
        content = report_material.identification_result(
            table.name, measurements.tests, result, measurements.stiffness_unit, measurements.notes, damping
        )
        report_material.write_identification(measurements.tests, result, content, folder, damping, material)
    finish(content, out, as_json)


def _model(
    measured: bool,
    model: str,
    weights,
    taps: int,
    period: float,
    memory,
    instrument: dict[str, Any],
) -> Any:
    """The model to fit: a sampled FO-SLS for tests with a force (`measured`), else one of moduli. `instrument`: lag
    (ms) and corner (Hz) as given. Raises `InputError` for options of the other kind."""
    from hilbo.identification.moduli import Continuous, FractionalMaxwell
    from hilbo.identification.sampled import Sampled

    if measured:
        if model != "fosls" or weights:
            raise InputError("--model and --weights are for tables of moduli; tests with a force have the FO-SLS only.")
        lag, corner = instrument["lag"], instrument["corner"]
        corner = float("inf") if corner in ("none", "auto") else corner
        return Sampled(taps, period, memory, lag=lag if lag == "fit" else 1e-3 * lag, corner=corner)
    if instrument != {"lag": "fit", "corner": "auto"}:
        raise InputError("--lag and --corner are for tests with a force; a table of moduli has neither lag nor filter.")
    if model == "fractional-maxwell":
        return FractionalMaxwell(weights or "relative")
    return Continuous(weights or "range")


def passivity(
    K1: Annotated[float | None, typer.Option("--K1", help="N/mm.", show_default=False)] = None,
    B1: Annotated[float | None, typer.Option("--B1", help="N.s^alpha/mm.", show_default=False)] = None,
    alpha: Annotated[float | None, typer.Option("--alpha", help="Order.", show_default=False)] = None,
    K0: Annotated[float | None, typer.Option("--K0", help="N/mm; by default from --K-eff.")] = None,
    K_eff: Annotated[float | None, typer.Option("--K-eff", help="Effective stiffness H(1), N/mm.")] = None,
    damping: Annotated[float | None, typer.Option(help="Damping of the device, N.s/m.")] = None,
    delay: Annotated[
        float | None, typer.Option(help="Delay from the sample of the position to the output of its force, s.")
    ] = None,
    taps: Annotated[int | None, typer.Option("--N", min=1, help="Past samples of the model.")] = None,
    period: Annotated[float | None, typer.Option("--T", help="Sampling time, s.")] = None,
    memory: Annotated[str | None, typer.Option(help='"short" (N samples) or "full".')] = None,
    study: Annotated[Path | None, typer.Option("--study", help="Take omitted values from its [renderer].")] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder for figures and a page.")] = None,
    force: Force = False,
    as_json: Json = False,
) -> None:
    """Check whether a parameter set is passive on a device, by how much, and what the largest K1 is.

    Prints the result; with --out also writes figures and report.html.
    """
    if K1 is None or B1 is None or alpha is None:
        name = "K1" if K1 is None else "B1" if B1 is None else "alpha"
        raise InputError(f"--{name} is missing; a set has --K1, --B1 and --alpha.")
    check_choice("memory", memory, (None, "short", "full"))
    _positive("T", period)
    _positive("damping", damping)
    start()
    from hilbo.report.json_text import quoted
    from hilbo.report.passivity import passivity_result, passivity_words

    given = {"N": taps, "T": period, "memory": memory, "K_eff": K_eff, "damping": damping, "delay": delay}
    renderer = _renderer(study) | {name: value for name, value in given.items() if value is not None}
    if K0 is not None and K_eff is not None:
        raise InputError("--K0 and --K-eff are both given; one follows from the other, leave one out.")
    model = _rendered(K0, K1, B1, alpha, renderer)
    content = passivity_result(model, renderer["damping"], renderer["delay"])
    if out is not None:
        from hilbo.report.material import write_passivity

        with results(out, force) as folder:
            write_passivity(model, content, folder)
    if as_json:
        print(quoted(content, indent=2))
    else:
        print(passivity_words(content))
        if out is not None:
            print(f"{out / 'report.html'}", file=sys.stderr)


def _rendered(K0: float | None, K1: float, B1: float, alpha: float, renderer: dict[str, Any]) -> Any:
    """The FO-SLS as a renderer samples it; where K0 (N/mm) is None, with the K0 that gives the renderer's effective
    stiffness. Raises `InputError` for K1, B1 or alpha that `FOSLS` refuses, with or without K0."""
    import numpy as np

    from hilbo.viscoelastic import FOSLS

    def sampled(K0):  # of NumPy's numbers, so that NumPy computes, at once
        numbers = map(np.float64, (K0, K1, B1, alpha))
        return FOSLS(*numbers, renderer["N"], renderer["T"], memory=renderer["memory"])  # type: ignore[call-arg]

    if K0 is None:
        _order(alpha)
        K0 = renderer["K_eff"] - float(sampled(0.0).dc_gain())
    return sampled(K0)


def _renderer(study: Path | None) -> dict[str, Any]:
    """N, T, memory, K_eff, damping and delay of the [renderer] of a study file, or those of the paper for None. Raises
    `InputError` for a study without one."""
    if study is None:
        return {"N": 101, "T": 1e-3, "memory": "short", "K_eff": 0.44, "damping": 0.95, "delay": 0.0}
    from hilbo.study.file.reading import StudyFile

    mechanics = StudyFile.load(study).space.mechanics
    if mechanics is None:
        raise InputError(f"{study}: has no [renderer], so that there is nothing to be passive.")
    return {name: getattr(mechanics, name) for name in ("N", "T", "memory", "K_eff", "damping", "delay")}


def _order(alpha: float) -> None:
    """Raise `InputError` unless the order alpha is above 0 and at most 1."""
    if not 0 < alpha <= 1:
        raise InputError(f"alpha is {alpha}; it must be above 0 and at most 1: the order of the fractional element.")


def _number(name: str, text: str, words: tuple[str, ...]) -> float | str:
    """The text itself if it is one of the words, else as a number. Raises `InputError` if it is neither."""
    if text in words:
        return text
    try:
        return float(text)
    except ValueError:
        allowed = " or ".join(f'"{word}"' for word in words)
        raise InputError(f'--{name} is "{text}"; it must be a number or {allowed}.') from None


def _positive(name: str, value: float | None) -> None:
    """Raise `InputError` unless the option's value is None, or positive and finite."""
    if value is not None and not 0 < value < float("inf"):
        raise InputError(f"--{name} is {value}; it must be a number above 0.")
