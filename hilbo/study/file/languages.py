"""What participants read, in the languages that hilbo has texts in: files of hilbo/data/texts. Loads no JAX."""

import tomllib
from functools import cache
from importlib.resources import files
from typing import Literal

import msgspec

__all__ = ["LANGUAGES", "Language", "LanguageName", "language"]

LanguageName = Literal["en", "de", "fr"]
LANGUAGES: dict[LanguageName, str] = {"en": "English", "de": "German", "fr": "French"}


class Language(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`texts`: every text, by its key, in which `{trial}`, `{done}` and `{of}` are numbers. `labels`, `definitions`: of
    the paper's answers. `reviewed`: whether a native speaker has read all of it."""

    texts: dict[str, str]
    labels: dict[str, str]
    definitions: dict[str, str]
    reviewed: bool


@cache
def language(name: LanguageName) -> Language:
    """The texts of a language."""
    content = (files("hilbo") / "data" / "texts" / f"{name}.toml").read_text(encoding="utf-8")
    return msgspec.convert(tomllib.loads(content), Language)
