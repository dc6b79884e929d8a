"""Figures as files: PNG for pages, SVG and PDF for papers."""

import io
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

__all__ = ["write_figure"]

_UNDATED = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}  # the same figure is the same file


def write_figure(figure: Figure, folder: Path, name: str) -> bytes:
    """Write NAME.png, NAME.svg and NAME.pdf, with letters that stay text in the PDF; returns the PNG."""
    _place(figure)
    for kind, metadata in _UNDATED.items():
        with mpl.rc_context({"pdf.fonttype": 42, "svg.hashsalt": name}):
            figure.savefig(folder / f"{name}.{kind}", metadata=metadata)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=200)
    (folder / f"{name}.png").write_bytes(buffer.getvalue())
    return buffer.getvalue()


def _place(figure: Figure) -> None:
    """Find everything's place in a figure, once for all its files: more than half of what drawing costs."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)
