"""A second process that writes figures, so that two cores draw at the same time.

It is forked before this process has threads, loads matplotlib while this one loads JAX, and ends with it. A figure
gives the same files, byte for byte, in either process.
"""

import contextlib
import importlib
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

__all__ = ["begin_painter", "write_figures"]

_painter: list[Connection] = []


def begin_painter() -> None:
    """Start the second process, which `write_figures` uses from then on, once per process.

    Nothing happens if it is already running, on one core, on macOS and systems without fork, and if a fork is unsafe:
    after threads were started or JAX was imported.
    """
    if _painter or not hasattr(os, "fork") or sys.platform == "darwin" or (os.cpu_count() or 1) < 2:
        return
    if threading.active_count() > 1 or "jax" in sys.modules:
        return
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe()
    context.Process(target=_paint, args=(there, here), daemon=True, name="painter").start()
    there.close()
    _painter.append(here)


def write_figures(figures: Mapping[str, Any], folder: Path) -> dict[str, bytes]:
    """Write matplotlib figures by name, each as PNG, SVG and PDF, into an existing folder; return their PNGs by name,
    in the order given.

    The second process, if it runs, takes figures from the front and this one from the back. If it fails, this process
    writes missing items.
    """
    from hilbo.report.figures.files import write_figure

    left, written = deque(figures.items()), {}
    with ThreadPoolExecutor(1) as beside:
        given = beside.submit(_give, _painter[0], left, folder, written) if _painter else None
        while left:
            with contextlib.suppress(IndexError):  # the painter has taken the last one
                name, figure = left.pop()
                written[name] = write_figure(figure, folder, name)
    if given is not None:
        given.result()
    for name in (name for name in figures if name not in written):  # the painter failed, or was killed
        written[name] = write_figure(figures[name], folder, name)
    return {name: written[name] for name in figures}


def _give(painter: Connection, left: deque[tuple[str, Any]], folder: Path, written: dict[str, bytes]) -> None:
    """Send figures from the front of `left` to the second process, one after the other, and put the PNGs that it could
    draw into `written`.

    Ends when none are left, or when the process has ended, which is then forgotten; the figure sent last is then
    missing.
    """
    with contextlib.suppress(IndexError):
        while True:
            name, figure = left.popleft()
            try:
                painter.send((figure, folder, name))
                png = painter.recv()
            except (EOFError, OSError):
                _painter.clear()
                return
            if png is not None:
                written[name] = png


def _paint(pipe: Connection, others: Connection) -> None:
    """Main loop of the second process: receive figures through `pipe`, write them, send back their PNGs, or None for
    one that cannot be drawn. Interruptions are ignored; it ends when the pipe is closed. `others`: the parent's end,
    closed here.
    """
    others.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process decides what an interruption ends
    for backend in ("agg", "pdf", "svg"):  # loaded before they are needed
        importlib.import_module(f"matplotlib.backends.backend_{backend}")
    from hilbo.report.figures.files import write_figure

    with contextlib.suppress(EOFError, OSError):
        while True:
            figure, folder, name = pipe.recv()
            try:
                png = write_figure(figure, folder, name)
            except Exception:
                png = None
            pipe.send(png)
