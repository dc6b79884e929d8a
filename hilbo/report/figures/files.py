"""Figures as files: PNG for pages, SVG and PDF for papers."""

import io
from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

__all__ = ["write_figure"]

_UNDATED = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}  # the same figure is the same file


def write_figure(figure: Figure, folder: Path, name: str) -> bytes:
    """Write NAME.png, NAME.svg and NAME.pdf into an existing folder, over earlier ones; return the PNG as bytes.

    Text stays text in the PDF, and equal figures give equal files. The figure's layout is fixed by the call.
    """
    _place(figure)
    for kind, metadata in _UNDATED.items():
        with mpl.rc_context({"pdf.fonttype": 42, "svg.hashsalt": name}):
            figure.savefig(folder / f"{name}.{kind}", metadata=metadata)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=200)
    (folder / f"{name}.png").write_bytes(buffer.getvalue())
    return buffer.getvalue()


def _place(figure: Figure) -> None:
    """Compute the layout of a figure once for all its files, which takes more than half of the time of drawing, and
    switch its layout engine off.
    """
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)
        figure.set_layout_engine(None)
