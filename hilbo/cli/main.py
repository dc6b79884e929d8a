"""The command line: all commands, and how each run ends.

The commands are functions of the other modules of this folder, the only places that parse arguments. Results go to a
folder, machine-readable ones with `--json` to stdout, progress to stderr (`console`). Exit code 0: done, 1: failed, 2:
bad usage or bad input, in one sentence.
"""

import sys
import warnings
from typing import Annotated

import typer

from hilbo.cli import live as cli_live
from hilbo.cli import material as cli_material
from hilbo.cli import plan as cli_plan
from hilbo.cli import session
from hilbo.cli import study as cli_study
from hilbo.cli import tried as cli_tried
from hilbo.cli.aggregate import aggregate, robustness
from hilbo.cli.cache import cache
from hilbo.cli.demo import demo
from hilbo.cli.device import commands as device
from hilbo.cli.imports import imports
from hilbo.cli.init import init
from hilbo.cli.simulate import simulate
from hilbo.cli.terminal.console import fail, say_remarks
from hilbo.cli.terminal.renamed import check_renamed
from hilbo.errors import InputError

__all__ = ["app", "main"]

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",  # brackets in help are names of tables
)


def _say_version(wanted: bool) -> bool:
    """Print hilbo's version and exit if the option is given; else return False."""
    if wanted:
        import hilbo

        print(f"hilbo {hilbo.__version__}")
        raise typer.Exit
    return wanted


@app.callback()
def _all(
    version: Annotated[
        bool, typer.Option("--version", callback=_say_version, is_eager=True, help="Print hilbo's version.")
    ] = False,
) -> None:
    """Estimate the population optimum from participants' ordinal responses, for haptic rendering of viscoelastic
    material."""


def main() -> None:
    """Entry point: run the command of the arguments. Ends the process after an error, with one sentence on stderr: code
    2 for bad input, 1 for any other failure; remarks on the input are printed as sentences too."""
    warnings.showwarning = say_remarks(warnings.showwarning)
    try:
        check_renamed(sys.argv[1:])
        app()
    except InputError as error:
        fail(str(error), 2)
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        reason = error.strerror or " ".join(str(error).split()) or type(error).__name__
        fail(f"{place}could not be read or written ({reason}); check path, rights and the space on the disk.", 1)
    except RuntimeError as error:
        fail(f"{type(error).__name__}: {error}", 1)


app.command()(aggregate)
app.command()(simulate)
app.command()(robustness)
app.command()(cli_material.identify)
app.command()(cli_material.passivity)
app.command()(cli_study.validate)
app.command()(cli_study.power)
app.command()(cli_study.report)
app.add_typer(device.app, name="device")
app.command()(cli_live.session)
app.command()(cli_live.doctor)
app.command("try")(cli_tried.tried)
app.command()(init)
app.command("import")(imports)
app.command()(cli_plan.plan)
app.command()(session.export)
app.add_typer(session.app_participants, name="participants")
app.command()(cache)
app.command()(demo)
