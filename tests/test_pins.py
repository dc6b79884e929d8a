"""The pins of constraints.txt install with the oldest Python that pyproject.toml promises.

pip takes a release that asks for a newer Python for one that does not exist. An environment of a newer Python does
not show it.
"""

import re
import tomllib
from importlib.metadata import distributions
from pathlib import Path

from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).parents[1]


def oldest_python() -> str:
    """The first release of the lowest Python of pyproject.toml, as "3.11.0"."""
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["requires-python"]
    return f"{stated.removeprefix('>=')}.0"


def asking_for_newer(asked: dict[str, str], python: str) -> list[str]:
    """What does not install with a Python, of packages and the Pythons that they ask for."""
    return [name for name, specifier in asked.items() if Version(python) not in SpecifierSet(specifier)]


def test_every_installed_pin_takes_the_oldest_python():
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = {canonicalize_name(name): release for name, release in (x.split("==") for x in lines if re.match(r"\w", x))}
    asked = {
        canonicalize_name(installed.name): installed.metadata.get("Requires-Python") or ""
        for installed in distributions()
        if pins.get(canonicalize_name(installed.name)) == installed.version
    }
    assert asking_for_newer(asked, oldest_python()) == []


def test_a_pin_for_newer_pythons_is_seen():
    assert asking_for_newer({"old": ">=3.9", "new": ">=3.11.5"}, "3.11.0") == ["new"]
