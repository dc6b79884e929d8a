"""Every script of notebooks/ as a notebook with its outputs, run in an empty folder: `make notebooks`.

HILBO_NOTEBOOK_TRIALS=7 makes the sessions in them short.
"""

import tempfile

import nbformat
from hooks import EXECUTED, NOTEBOOKS, ROOT, cells
from nbclient import NotebookClient


def main() -> None:
    EXECUTED.mkdir(parents=True, exist_ok=True)
    for name in NOTEBOOKS:
        path = ROOT / name
        kinds = {"markdown": nbformat.v4.new_markdown_cell, "code": nbformat.v4.new_code_cell}
        # Ids by number: the same script makes the same file.
        made = [kinds[kind](text, id=f"cell-{number}") for number, (kind, text) in enumerate(cells(path))]
        book = nbformat.v4.new_notebook(cells=made)
        with tempfile.TemporaryDirectory() as folder:
            NotebookClient(
                book,
                kernel_name="python3",
                timeout=900,
                coalesce_streams=True,
                resources={"metadata": {"path": folder}},
            ).execute()
        for cell in made:
            cell.metadata.pop("execution", None)  # times
        nbformat.write(book, EXECUTED / f"{path.stem}.ipynb")
        print(f"{path.stem}.ipynb", flush=True)


if __name__ == "__main__":
    main()
