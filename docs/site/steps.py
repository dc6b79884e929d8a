"""A page that walks a study: words, commands, what they say, and figures. Scripts beside this one name the steps.

What stands on such a page is what the commands said, less times and what is of one machine alone; the figures are
theirs.
"""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from PIL import Image

__all__ = ["Step", "copied", "section", "written"]

# Times, and progress.
_UNSAID = r"done in|\d+ of \d+ (studies|designs|maps|parts|predictions)|sweep \d+|(relaxation|creep) \d+ of"


class Step(NamedTuple):
    """A section of a page: words, a command, and what is shown of it.

    `command`: empty for words alone. `shown`: pattern of the lines that are shown; `files`: shown whole; `figures`:
    files and captions. `before`: is run first, with the folder of the study; `instead`: is run in place of the command,
    with the folder, and returns what is shown; `answers`: options in place of the answers that a person types.
    """

    words: str
    command: str = ""
    shown: str = r".*"
    files: tuple[str, ...] = ()
    figures: tuple[tuple[str, str], ...] = ()
    before: Callable[[Path], None] | None = None
    instead: Callable[[Path], str] | None = None
    answers: tuple[str, ...] = ()


def written(step: Step, folder: Path) -> str:
    """Run a step in `folder`, and return what its command wrote to stderr and stdout (` > FILE` at its end keeps that
    in a file), of the lines those that are shown. Raises SystemExit if the command fails."""
    if step.instead is not None:
        return step.instead(folder)
    said, _, kept = step.command.partition(" > ")
    _, *words = shlex.split(said)
    command = [Path(sys.executable).with_name("hilbo"), *words, *step.answers]
    env = os.environ | {"COLUMNS": "120", "NO_COLOR": "1"}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{step.command}: exit code {done.returncode}\n{done.stderr}")
    if kept:
        (folder / kept).write_text(done.stdout, encoding="utf-8")
    lines = (done.stderr + ("" if kept else done.stdout)).splitlines()
    return "\n".join(line for line in lines if re.match(step.shown, line) and not re.match(_UNSAID, line))


def section(step: Step, folder: Path, figures: Path) -> str:
    """Run a step in `folder`, and return its part of the page; its figures go to the folder `figures`, with few
    colours, which is smaller."""
    if step.before is not None:
        step.before(folder)
    said = written(step, folder) if step.command or step.instead else ""
    parts = [step.words] if step.words else []
    parts += [f"```\n{step.command}\n```"] if step.command else []
    parts += [f"```text\n{said}\n```"] if said else []
    for name in step.files:
        kind = {".toml": "toml", ".md": "markdown"}.get(Path(name).suffix, "text")
        parts.append(f"`{name}`:\n\n```{kind}\n{(folder / name).read_text(encoding='utf-8').strip()}\n```")
    for name, caption in step.figures:
        figure = name.replace("/", "-")
        image = Image.open(folder / name).convert("RGB").quantize(256, method=Image.Quantize.MAXCOVERAGE)
        image.save(figures / figure, optimize=True)
        parts.append(f"![{caption}]({figures.name}/{figure})\n\n*{caption}*")
    return "\n\n".join(parts)


def copied(files: dict[str, str]) -> Callable[[Path], None]:
    """What copies files of a study: source -> target, both within its folder."""

    def copy(folder: Path) -> None:
        for source, target in files.items():
            (folder / target).parent.mkdir(exist_ok=True)
            shutil.copy(folder / source, folder / target)

    return copy
