"""A command of hilbo in this process."""

import sys

import pytest

from hilbo.cli import main

__all__ = ["run"]


def run(capsys, monkeypatch, *arguments):
    """Exit code, stdout and stderr of `hilbo ARGUMENTS`."""
    monkeypatch.setattr(sys, "argv", ["hilbo", *map(str, arguments)])
    with pytest.raises(SystemExit) as stopped:
        main.main()
    captured = capsys.readouterr()
    return stopped.value.code or 0, captured.out, captured.err
