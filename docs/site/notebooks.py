"""Every script of notebooks/ as a notebook with its outputs, run in an empty folder: `make notebooks`.

HILBO_NOTEBOOK_TRIALS=7 makes the sessions in them short.
"""

import tempfile
from pathlib import Path

import nbformat
from hooks import EXECUTED, NOTEBOOKS, ROOT, cells
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
    EXECUTED.mkdir(parents=True, exist_ok=True)
    for name in NOTEBOOKS:
        with tempfile.TemporaryDirectory() as folder:
            book = executed(ROOT / name, folder)
        made = EXECUTED / f"{Path(name).stem}.ipynb"
        nbformat.write(book, made)
        print(made.name, flush=True)


if __name__ == "__main__":
    main()
