"""Texts that participants read, in the languages that hilbo has: files of hilbo/data/texts. Loads no JAX."""

import tomllib
from functools import cache
from importlib.resources import files
from typing import Literal

import msgspec

__all__ = ["LANGUAGES", "Language", "LanguageName", "language"]

LanguageName = Literal["en", "de", "fr"]
LANGUAGES: dict[LanguageName, str] = {"en": "English", "de": "German", "fr": "French"}


class Language(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`texts`: every text by its key, with the placeholders `{trial}`, `{done}` and `{of}` for numbers. `labels`,
    `definitions`: of the paper's responses. `reviewed`: whether a native speaker has checked all of it."""

    texts: dict[str, str]
    labels: dict[str, str]
    definitions: dict[str, str]
    reviewed: bool


@cache
def language(name: LanguageName) -> Language:
    """The texts of a language, read from hilbo/data/texts on the first call and cached."""
    content = (files("hilbo") / "data" / "texts" / f"{name}.toml").read_text(encoding="utf-8")
    return msgspec.convert(tomllib.loads(content), Language)
