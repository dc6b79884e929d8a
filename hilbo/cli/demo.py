"""`hilbo demo`: the responses of real people, and a simulated study compared with its truth and the paper."""

from pathlib import Path
from typing import Annotated, Any

from hilbo.cli.aggregate import aggregate_cohort, read_cohort
from hilbo.cli.study import simulated_report
from hilbo.cli.terminal.console import PARTS, Force, Out, progress, results, seed_option

__all__ = ["demo"]


def demo(
    out: Out = Path("demo-results"),
    seed: Annotated[int, seed_option("of the simulated participants and of the candidate points of the optima")] = 0,
    force: Force = False,
) -> None:
    """Aggregate a real data set, then simulate a whole haptic study of known truth and report on it.

    Writes both results folders to --out, and prints their optima with those of the paper.
    """
    from importlib.resources import files

    data = files("hilbo") / "data"
    with results(out, force) as folder, progress() as say:
        for name in PARTS:
            (folder / name).mkdir()
        table, study = (Path(str(data / f"video_quality.{kind}")) for kind in ("csv", "toml"))
        chosen, cohort, _ = read_cohort(table, study, None, say)
        real = aggregate_cohort(chosen, cohort, folder / PARTS[0], seed, say)
        simulated = simulated_report(folder / PARTS[1], seed, say)["materials"][""]
    _print_demo(real, simulated, out)


def _print_demo(real: dict[str, Any], simulated: dict[str, Any], out: Path) -> None:
    """Print the optimum of the real data, the errors of the simulated study beside the paper's, and the paths of both
    reports. `real`, `simulated`: contents of result.json."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as RichTable

    from hilbo.population.rules.registry import RECOMMENDED

    console = Console(highlight=False, soft_wrap=True)
    best = real["optimum"]["parameters"]
    console.print(f"\nVideo quality, {len(real['participants'])} participants: the map is highest at", end=" ")
    console.print(", ".join(f"{name} = {value:.0f}" for name, value in best.items()) + ".\n")
    truth = simulated["truth"]
    table = RichTable(
        title="Simulated memory foam, 24 participants x 25 trials: NRMSE to the truth, of the search ranges",
        box=box.SIMPLE_HEAD,
        title_justify="left",
        pad_edge=False,
    )
    for head in ("", "K1, B1, alpha", "with K0", "passive by", "the paper"):
        table.add_column(head, justify="right" if head else "left", no_wrap=True)

    def row(name, key, optimum, paper):
        miss, margin = truth["nrmse"][key], optimum["passivity_margin"]
        passive = f"{'yes' if margin >= 0 else 'no'}, {margin:+.3f}"
        table.add_row(name, f"{100 * miss['nrmse']:.1f} %", f"{100 * miss['nrmse_with_K0']:.1f} %", passive, paper)

    row("map by bcm", "aggregate", simulated["optimum"], "4 %, yes")
    row(f"map by {RECOMMENDED}", RECOMMENDED, simulated["alternatives"][RECOMMENDED], "")
    q, qk = truth["individuals"]["quartiles"], truth["individuals"]["with_K0"]
    spread = [f"{100 * v[1]:.0f} % ({100 * v[0]:.0f}–{100 * v[2]:.0f})" for v in (q, qk)]
    margins = [person["optimum"]["passivity_margin"] for person in simulated["participants"]]
    passive = f"{sum(margin >= 0 for margin in margins)} of {len(margins)}"
    table.add_row("individuals", *spread, passive, "24 % (13–41)")
    row("mean of optima", "mean_of_optima", simulated["mean_of_optima"], "10.5 %, no")
    row("mean of maps", "average", simulated["alternatives"]["average"], "")
    console.print(table)
    console.print("Individuals: median and quartiles. Passivity margin: excess damping in N.s/m.")
    top = truth["top_answers"]
    console.print(f'"close" responses of 25: {top["mean"]:.2f} ± {top["sd"]:.2f} (paper: 5.96 ± 4.47)')
    console.print(
        "This is one study with one seed. Over three thousand simulated studies of 24 x 25 the median error is 8.8 % by"
        f" bcm and 4.5 % by {RECOMMENDED} (docs/methods/which_method.md).\n"
    )
    for name in PARTS:
        console.print(str(out / name / "report.html"))
