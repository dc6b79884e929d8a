"""The examples of each client's language as processes: compiled as their first lines say, and run as their users do."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple

import pytest
from live_stimulus import CLIENTS

__all__ = ["LANGUAGES", "Language", "each_language", "hung", "of_languages", "sources"]


class Language(NamedTuple):
    """`tools`: what has to be there. `build(example, folder)`: the command of an example among sources, without link.
    `hangs`: what has its own loop hang where it stands behind `presented()`; "" where there is one thread."""

    name: str
    tools: tuple[str, ...]
    build: Callable[[str, Path], list[str]]
    ending: str
    hangs: str

    def missing(self) -> str:
        """The tools that are not here, in words."""
        return ", ".join(tool for tool in self.tools if shutil.which(tool) is None)


def sources(folder: Path) -> Path:
    """The clients' files, in a folder of their own, to be compiled there."""
    if not folder.exists():
        shutil.copytree(CLIENTS, folder, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def hung(language: Language, folder: Path) -> Path:
    """The same, but that the own loop of the language's spring hangs as soon as it has presented."""
    sources(folder)
    (file,) = (path for path in folder.glob(f"*{language.ending}") if path.stem.lower().endswith("spring"))
    calls = [word for word in ("stimulus.presented()", "stimulus.Presented()") if word in file.read_text()]
    (call,) = calls
    text = file.read_text()
    if language.hangs not in text:
        file.write_text(text.replace(call, call + language.hangs))
    return folder


def _python(example: str, folder: Path) -> list[str]:
    return [sys.executable, str(folder / f"{example}.py")]


def _cpp(example: str, folder: Path) -> list[str]:
    program = folder / example
    if not program.exists():
        warnings = ("-std=c++11", "-Wall", "-Wextra", "-Werror", "-pedantic", "-pthread")
        subprocess.run(["g++", *warnings, str(folder / f"{example}.cpp"), "-o", str(program)], check=True)
    return [str(program)]


def _matlab(example: str, folder: Path) -> list[str]:
    script = folder / f"run_{example}.m"
    said = "fprintf(2, '%s\\n', problem.message); status = 1;"
    words = f"status = 0;\ntry\n  {example}(argv(){{1}});\ncatch problem\n  {said}\nend\nexit(status);\n"
    script.write_text(f"addpath('{folder}');\n{words}")
    return ["octave-cli", "--no-init-file", "--quiet", str(script)]


def _csharp(example: str, folder: Path) -> list[str]:
    name = "".join(part.capitalize() for part in example.split("_"))
    program = folder / f"{name}.exe"
    if not program.exists():
        files = [str(folder / f"{name}.cs"), str(folder / "HilboStimulus.cs")]
        subprocess.run(["mcs", "-warnaserror", "-warn:4", "-langversion:6", *files, f"-out:{program}"], check=True)
    return ["mono", str(program)]


LANGUAGES = (
    Language("python", (), _python, ".py", ", time.sleep(600)"),
    Language("c++", ("g++",), _cpp, ".cpp", ", std::this_thread::sleep_for(std::chrono::seconds(600))"),
    Language("matlab", ("octave-cli",), _matlab, ".m", ""),
    Language("c#", ("mcs", "mono"), _csharp, ".cs", "; Thread.Sleep(600000)"),
)


def of_languages(release: Collection[str] = ()) -> list:
    """Parameters of a test, one for each language; those in `release` are tried before a release only."""

    def marks(language: Language) -> list:
        missing = pytest.mark.skipif(bool(language.missing()), reason=f"{language.missing()} is missing")
        return [missing, *([pytest.mark.release] if language.name in release else [])]

    return [pytest.param(language, id=language.name, marks=marks(language)) for language in LANGUAGES]


each_language = pytest.mark.parametrize("language", of_languages())
