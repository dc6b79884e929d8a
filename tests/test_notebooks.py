"""Every notebook runs from top to bottom as a user would run it, and none is forgotten."""

import importlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted(ROOT.glob("notebooks/*.py"))
LONG = ("report",)  # three materials: minutes


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 2


@pytest.mark.deep
@pytest.mark.parametrize(
    "path",
    [pytest.param(path, id=path.stem, marks=[pytest.mark.release] if path.stem in LONG else []) for path in NOTEBOOKS],
)
def test_notebook_runs(path, tmp_path, monkeypatch):
    """In a kernel and an empty folder, as a user runs it: it finds what it needs wherever it is opened, and shows a
    picture."""
    pytest.importorskip("nbclient", reason="needs the extra docs")
    monkeypatch.setenv("HILBO_NOTEBOOK_TRIALS", "7")
    monkeypatch.delenv("MPLBACKEND", raising=False)  # in a kernel pyplot shows its figures below their cells
    monkeypatch.syspath_prepend(ROOT / "docs" / "site")
    book = importlib.import_module("notebooks").executed(path, str(tmp_path))
    outputs = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    assert any(output.output_type == "stream" and output.name == "stdout" for output in outputs)
    images = sum("image/png" in output.get("data", {}) for output in outputs)
    figures = [text for output in outputs if "Figure" in (text := output.get("data", {}).get("text/plain", ""))]
    assert images >= 1 and len(figures) <= images, figures
