"""The examples of each client's language as processes: compiled as their first lines say, and run as their users do."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest
from live_stimulus import CLIENTS

__all__ = ["LANGUAGES", "Language", "each_language"]


class Language(NamedTuple):
    """`tools`: what has to be there. `build(example, folder)`: the command of an example, without the link. `slower`: s
    by which it may be later to see that the server is silent, as its first lines say."""

    name: str
    tools: tuple[str, ...]
    build: Callable[[str, Path], list[str]]
    slower: float = 0.0

    def missing(self) -> str:
        """The tools that are not here, in words."""
        return ", ".join(tool for tool in self.tools if shutil.which(tool) is None)


def _python(example: str, _folder: Path) -> list[str]:
    return [sys.executable, str(CLIENTS / f"{example}.py")]


def _cpp(example: str, folder: Path) -> list[str]:
    program = folder / example
    if not program.exists():
        warnings = ("-std=c++11", "-Wall", "-Wextra", "-Werror", "-pedantic", "-pthread")
        subprocess.run(["g++", *warnings, str(CLIENTS / f"{example}.cpp"), "-o", str(program)], check=True)
    return [str(program)]


LANGUAGES = (
    Language("python", (), _python),
    Language("c++", ("g++",), _cpp),
)
each_language = pytest.mark.parametrize(
    "language",
    [
        pytest.param(
            language,
            id=language.name,
            marks=pytest.mark.skipif(bool(language.missing()), reason=f"{language.missing()} is missing"),
        )
        for language in LANGUAGES
    ],
)
