"""Figures are the same files, byte for byte, whoever writes them, and none is lost where the second process is."""

import subprocess
import sys

import pytest

DRAW = """
import multiprocessing, os, signal, sys
from pathlib import Path

import hilbo.report.figures.painter as painter

painter.begin_painter()
from matplotlib.figure import Figure

def figures():
    made = {name: Figure(figsize=(2, 2), layout="constrained") for name in "abcd"}
    for power, figure in enumerate(made.values()):
        figure.subplots().plot([0, 1, 2], [0, 1, 2**power])
    return made

def files(name):
    folder = Path(name)
    folder.mkdir()
    pngs = painter.write_figures(figures(), folder)
    assert list(pngs) == list("abcd"), pngs.keys()
    assert all(pngs[name] == (folder / f"{name}.png").read_bytes() for name in pngs)
    return {path.name: path.read_bytes() for path in folder.iterdir()}

class Counting:
    # The pipe to the second process, and how many figures it was given.
    given = 0
    def __init__(self, pipe):
        self.pipe, self.recv = pipe, pipe.recv
    def send(self, task):
        Counting.given += 1
        self.pipe.send(task)

(process,) = multiprocessing.active_children()
painter._painter[0] = Counting(painter._painter[0])
both = files("both")
assert Counting.given, "the second process was given nothing"
os.kill(process.pid, signal.SIGKILL)
process.join()
killed = files("killed")
assert not painter._painter
assert len(both) == 12 and both == killed == files("alone")
"""


@pytest.mark.deep  # processes that draw: 3 s
def test_figures_are_the_same_by_one_process_by_two_and_after_one_was_killed(tmp_path):
    # A process of its own, a second: nothing is forked where JAX is loaded, as it is here.
    done = subprocess.run([sys.executable, "-c", DRAW], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
