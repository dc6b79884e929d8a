"""The part of a study file that determines what responses mean, and the differences between two study files.

Logs, plans and results whose study files agree in this part are read together. The other keys, such as the number of
trials, the steps of a trial or the hyperparameters, may change between sessions. Materials are compared one by one, as
the files that their overrides make (`StudyFile.material`).
"""

from hilbo.study.file.languages import language
from hilbo.study.formats.json_file import Content

__all__ = ["MEANING", "differing_keys", "meaning_part"]

MEANING = (
    "study.responses",
    "study.attribute",
    "parameters",
    "constraints",
    "renderer",
    "stimulus",
    "session.labels",
    "session.definitions",
    "session.texts.question",
    "session.texts.question_a",
    "session.texts.question_b",
    "session.texts.question_preferred",
)
"""Keys, with all keys below them, that determine what a response means, but for `FREE`."""
FREE = {"stimulus": ("within", "silence"), "parameters": ("correlation", "ordered", "at", "natural_ends")}
"""Keys below them that do not: how long a presenter is waited for, assumptions of the prior, and natural ends."""


def meaning_part(tables: Content) -> Content:
    """Those of the `MEANING` keys that a study file (parsed, without defaults) has, with their values, and the order of
    its parameters. Texts of the file's language count as left out: a translation asks the same."""
    session = tables.get("session", {})
    own = language(session.get("language", "en"))
    labels, definitions = session.get("labels", {}), session.get("definitions", {})
    part: Content = {
        "order of the parameters": list(tables["parameters"]),
        "parameters": {name: _without(table, FREE["parameters"]) for name, table in tables["parameters"].items()},
        "session.labels": {k: v for k, v in labels.items() if v != own.labels.get(k, k.capitalize())},
        "session.definitions": {k: v for k, v in definitions.items() if v != own.definitions.get(k, "")},
    }
    if "stimulus" in tables or "renderer" not in tables:  # else a device renders
        part["stimulus"] = {"by": "program"} | _without(tables.get("stimulus", {}), FREE["stimulus"])
    for name, text in session.get("texts", {}).items():
        if f"session.texts.{name}" in MEANING and text != own.texts[name]:
            part[f"session.texts.{name}"] = text
    for table, name in (("study", "responses"), ("study", "attribute"), ("", "constraints"), ("", "renderer")):
        place = tables[table] if table else tables
        if name in place:
            part[f"{table}.{name}".removeprefix(".")] = place[name]
    return part


def differing_keys(one: Content, other: Content, prefix: str = "") -> list[str]:
    """Dotted keys whose values differ between two parsed study files, in the order of their first occurrence. Tables
    with the same content in another order count as a difference of the whole table."""
    keys = []
    for name in dict.fromkeys([*one, *other]):
        a, b = one.get(name), other.get(name)
        if isinstance(a, dict) and isinstance(b, dict):
            keys += differing_keys(a, b, f"{prefix}{name}.")
        elif isinstance(a or b, dict) and not (a and b):
            keys += differing_keys(a or {}, b or {}, f"{prefix}{name}.")
        elif a != b:
            keys.append(prefix + name)
    if not keys and list(one) != list(other):
        return [prefix.removesuffix(".") or "the order of the tables"]
    return keys


def _without(table: Content, keys: tuple[str, ...]) -> Content:
    """Copy of a table without some of its keys."""
    return {key: value for key, value in table.items() if key not in keys}
