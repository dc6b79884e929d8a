"""What the commands say while they work, and the folder that is whole or absent."""

import os
import signal
import subprocess
import sys

import pytest

from hilbo.cli.terminal.console import _Pace, progress, results
from hilbo.errors import InputError


def test_work_that_goes_by_people_says_how_many_and_how_long():
    pace = _Pace()
    assert pace.line("reading", None, None, 0.0) == ("reading", True)
    assert pace.line("people fitted", 100, 1100, 30.0) == ("100 of 1,100 people fitted", True)  # no pace yet
    assert pace.line("people fitted", 200, 1100, 30.5) == ("200 of 1,100 people fitted, 0:04 left", False)
    assert pace.line("people fitted", 300, 1100, 40.0) == ("300 of 1,100 people fitted, 0:40 left", True)
    assert pace.line("people fitted", 1100, 1100, 41.0) == ("1,100 of 1,100 people fitted", False)
    assert pace.line("people fitted", 100, 1100, 42.0)[0] == "100 of 1,100 people fitted"  # the next pass
    assert pace.line("people fitted", 300, 1100, 42.9) == ("300 of 1,100 people fitted, 0:04 left", False)
    assert pace.line("folds", 1, 9, 50.0) == ("1 of 9 folds", True)
    assert pace.line("folds", 2, 9, 51.5) == ("2 of 9 folds, 0:10 left", True)  # soon, since it tells the time left
    assert pace.line("folds", 3, 9, 53.0) == ("3 of 9 folds, 0:09 left", False)
    assert pace.line("rows read", 50_000, None, 43.0) == ("50,000 rows read", True)


def test_progress_goes_to_stderr_and_may_be_quiet(capsys):
    with progress() as say:
        say("people fitted", 2, 3)
    with progress(quiet=True) as say:
        say("silence")
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("2 of 3 people fitted\ndone in ") and "silence" not in err


def test_a_folder_is_whole_or_absent(tmp_path):
    def failing():
        with results(tmp_path / "out", False) as folder:
            (folder / "result.json").write_text("{}")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        failing()
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"), results(tmp_path / "file" / "out", False):
        pass


def test_a_command_that_is_told_to_end_leaves_nothing_behind(tmp_path):
    def told():
        with results(tmp_path / "out", False) as folder:
            (folder / "half").write_text("")
            signal.raise_signal(signal.SIGTERM)

    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as ended:
        told()
    assert ended.value.code == 143 and not list(tmp_path.iterdir())
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("force", [False, True])
def test_what_came_meanwhile_stays(tmp_path, force):
    """And what was computed stays too, beside it."""
    out = tmp_path / "out"

    def run():
        with results(out, force) as folder:
            (folder / "result.json").write_text("{}")
            out.mkdir()
            (out / "notes.txt").write_text("precious")

    with pytest.raises(InputError, match=r"these results are in .*out-2\.$"):
        run()
    assert (out / "notes.txt").read_text() == "precious" and (tmp_path / "out-2" / "result.json").exists()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "out-2"]


@pytest.mark.parametrize(
    ("given", "holds"), [({}, "1"), pytest.param({"OPENBLAS_NUM_THREADS": "3"}, "3", marks=pytest.mark.deep)]
)
def test_openblas_has_one_thread_unless_it_was_told_otherwise(given, holds):
    """In a process of its own, since it is told before NumPy is loaded: `import jax` takes the test's time."""
    code = (
        "import sys; from hilbo.cli.terminal.console import start\n"
        "assert 'numpy' not in sys.modules; start()\n"
        "import os; print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    plain = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run([sys.executable, "-c", code], env=plain | given, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == holds
