"""`hilbo cache`: show or delete the compiled functions that are cached between commands."""

import shutil
from pathlib import Path
from typing import Annotated

import typer

from hilbo.cli.terminal.console import JsonToo, cache_folder, print_result, remark
from hilbo.programs.entries import Entries

__all__ = ["cache"]


def cache(
    clear: Annotated[
        bool, typer.Option("--clear", help="Delete the cache; programs are compiled again when needed.")
    ] = False,
    as_json: JsonToo = False,
) -> None:
    """Show the cache of compiled functions (folder, number, size), or clear it."""
    folder = cache_folder()
    traced, compiled = Entries(folder / "programs", remark), folder / "jax"
    if clear:
        traced.clear()
        shutil.rmtree(compiled, ignore_errors=True)
    parts = {"traced": list(traced.sizes().values()), "compiled": [path.stat().st_size for path in _files(compiled)]}
    content = {"folder": str(folder)} | {
        name: {"programs": len(sizes), "bytes": sum(sizes)} for name, sizes in parts.items()
    }
    words = [f"{name}: {len(sizes)} programs, {sum(sizes) / 1e6:.1f} MB" for name, sizes in parts.items()]
    print_result(content, "\n".join([str(folder), *words]), as_json)


def _files(folder: Path) -> list[Path]:
    """The files of JAX's compilation cache in a folder; none if there is no such folder."""
    return [path for path in folder.glob("*-cache") if path.is_file()]
