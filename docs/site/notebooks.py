"""Every script of notebooks/ as a notebook with its outputs, run in an empty folder: `make notebooks`.

--changed, as in `make docs`: only of scripts that have changed since they were run.
HILBO_NOTEBOOK_TRIALS=7 makes the sessions in them short.
"""

import argparse
import tempfile
from pathlib import Path

import nbformat
from hooks import EXECUTED, NOTEBOOKS, ROOT, cells, outputs
from nbclient import NotebookClient


def executed(path: Path, folder: str) -> nbformat.NotebookNode:
    """The script `path` as a notebook with its outputs, run in `folder`."""
    kinds = {"markdown": nbformat.v4.new_markdown_cell, "code": nbformat.v4.new_code_cell}
    # Ids by number: the same script makes the same file.
    made = [kinds[kind](text, id=f"cell-{number}") for number, (kind, text) in enumerate(cells(path))]
    book = nbformat.v4.new_notebook(cells=made)
    resources = {"metadata": {"path": folder}}
    NotebookClient(book, kernel_name="python3", timeout=900, coalesce_streams=True, resources=resources).execute()
    for cell in made:
        cell.metadata.pop("execution", None)  # times
    return book


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--changed", action="store_true")
    chosen = options.parse_args()
    EXECUTED.mkdir(parents=True, exist_ok=True)
    for name in NOTEBOOKS:
        if chosen.changed and outputs(ROOT / name) is not None:
            continue
        with tempfile.TemporaryDirectory() as folder:
            book = executed(ROOT / name, folder)
        made = EXECUTED / f"{Path(name).stem}.ipynb"
        nbformat.write(book, made)
        print(made.name, flush=True)


if __name__ == "__main__":
    main()
