"""HTML and Markdown pages of results, from the Jinja templates of this folder, and the filters of the templates."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import islice
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from hilbo.population.rules.registry import RECOMMENDED, RULES
from hilbo.report.digits import parameter_text, parameter_texts
from hilbo.report.kernel_words import covariance_words, formula
from hilbo.report.participants import People
from hilbo.study.config import Study
from hilbo.study.formats.toml_text import toml_key, toml_string

__all__ = ["Pictures", "estimate_words", "heads", "number", "percent", "rendered", "results_page", "text_of"]

Pictures = dict[str, dict[str, str]]
"""Figures by name, each with `png` (base64) and `width` (pixels), of `results.save_figures`."""

_ESTIMATES = {
    "ep": "population map, expectation propagation",
    "laplace": "population map, Laplace",
    "mean_of_optima": "mean of the individual optima",
} | {rule.name: rule.label for rule in RULES.values()}
_SHOWN = 200  # participants in the page's table


def results_page(
    study: Study,
    content: dict[str, Any],
    figures: Pictures,
    people: People,
    *,
    how: str = "",
    drawn: Any = None,
    selection: str = "",
    comparison: Any = None,
    halves: int = 0,
) -> str:
    """The HTML page of an aggregation.

    **Arguments:**

    - `content`: of result.json; `people`: a row for each participant, of whom the table shows the first 200.
    - `how`: how maps of fewer trials are aggregated, where it is not as the map is.
    - `drawn`: of a large population, how many `participants` and individual `optima` its figures show.
    - `selection`: how the trials had been chosen, where that is known.
    - `comparison`: the section of `report.comparison`.
    - `halves`: number of random splits of the participants into halves, from which the uncertainty of the optimum after
      fewer trials is estimated; 0: none.
    """
    claims = {"aggregate": content["optimum"]} | content["alternatives"]
    if content["mean_of_optima"] is not None:
        claims["mean_of_optima"] = content["mean_of_optima"]
    return rendered(
        "report.html",
        study=study,
        content=content,
        warnings=content["warnings"],
        figures=figures,
        people=people,
        shown=[] if people.sets is None else list(islice(people.entries(), _SHOWN)),
        claims=claims,
        how=how,
        drawn=drawn,
        selection=selection,
        comparison=comparison,
        halves=halves,
        rule=RULES[content["rule"]],
    )


def estimate_words(name: str, rule: str) -> str:
    """Name of an estimate of the optimum on pages.

    `name`: its key in result.json, where "aggregate" is the map by the study's aggregation method `rule`. Raises
    `KeyError` for an unknown key.
    """
    return f"population map ({rule})" if name == "aggregate" else _ESTIMATES[name]


def footnotes(sentences: Sequence[str], names: Sequence[str]) -> dict[str, list[int]]:
    """Numbers (from 1) of the warnings `sentences` by what on the result card they concern: a parameter of `names`,
    "region" or "optimum".

    A sentence about the limits that the optimum lies on concerns the parameters that it names.
    """
    marks: dict[str, list[int]] = {}
    for k, text in enumerate(sentences, 1):
        named = [name for name in names if re.search(rf"(?<!\w){re.escape(name)}(?!\w)", text)]
        limit = text.startswith(("The optimum is at ", "The optimum is on "))
        for what in named if limit and named else ["region" if "credible region" in text else "optimum"]:
            marks.setdefault(what, []).append(k)
    return marks


def rendered(name: str, **facts: Any) -> str:
    """The HTML of a template; the values `facts` are escaped. Raises an error of Jinja for a name that is missing."""
    return _environment().get_template(name).render(**facts)


def text_of(name: str, **facts: Any) -> str:
    """The Markdown of a template, not escaped; lines with nothing but template tags leave no empty lines. Raises an
    error of Jinja for a name that is missing.
    """
    lines = _environment().overlay(trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    return lines.get_template(name).render(**facts)


@cache
def _environment() -> Environment:
    """The Jinja environment with the package's templates, filters and functions, made once per process. A name that is
    missing in a template is an error; only HTML is escaped.
    """
    environment = Environment(
        loader=PackageLoader("hilbo.report"), autoescape=select_autoescape(), undefined=StrictUndefined
    )
    environment.filters |= {
        "number": number,
        "ends": _ends,
        "as_toml": _as_toml,
        "percent": percent,
        "symbol": _symbol,
        "unit": _unit,
        "each": _each,
        "listed": _listed,
    }
    environment.globals |= {
        "heads": heads,
        "zip": zip,
        "nan": math.nan,
        "estimate_words": estimate_words,
        "width": width,
    }
    environment.globals |= {"shown": parameter_text, "listing": parameter_texts, "footnotes": footnotes}
    environment.globals |= {"covariance_words": covariance_words, "formula": formula, "recommended": RECOMMENDED}
    environment.globals["predicting"] = next(rule.name for rule in RULES.values() if rule.predicts)
    return environment


def heads(study: Study, names: Iterable[str]) -> list[str]:
    """Column heads of parameters, such as "K1 (N/mm)"; without a unit the name alone. `names`: of the study's
    parameters, or K0. Raises `KeyError` for others.
    """
    units = {"K0": "N/mm"} | {p.name: p.unit for p in study.space.parameters}
    return [f"{_symbol(name)} ({_unit(units[name])})" if units[name] else _symbol(name) for name in names]


def _symbol(name: str) -> str:
    """A parameter's name as printed: "α" for "alpha", others unchanged."""
    return "α" if name == "alpha" else name


def _unit(unit: str) -> str:
    """A unit of a study file as printed, such as "N·sᵅ/mm" for "N.s^alpha/mm"."""
    return unit.replace("^alpha", "^α").replace("s^α", "sᵅ").replace(".", "·")


def number(value: float | str) -> str:
    """A number as text with four significant digits, never with an exponent; a text (name of a level) unchanged."""
    if isinstance(value, str):
        return value
    return np.format_float_positional(value, precision=4, unique=False, fractional=False, trim="-")


def width(values: Sequence[float | str]) -> float:
    """Width of an interval with the ends `values`; NaN for names of levels."""
    return math.nan if isinstance(values[0], str) or isinstance(values[1], str) else values[1] - values[0]


def _ends(values: list[float | str], study: Study, name: str) -> str:
    """Range of a parameter's values as text, for a cell: "1 to 2" for the two ends `values`, "1" if they are equal, and
    "a or b" for names of levels.
    """
    texts = [parameter_text(study, name, value, width(values)) for value in dict.fromkeys(values)]
    return (" or " if isinstance(values[0], str) else " to ").join(texts)


def _as_toml(parameters: Mapping[str, float | str], study: Study) -> str:
    """A rendering as a table of TOML text, with units as comments."""
    units = {"K0": "N/mm"} | {p.name: p.unit for p in study.space.parameters}
    lines = ["[optimum]"]
    for name, value in parameters.items():
        text = toml_string(value) if isinstance(value, str) else repr(value)
        lines.append(f"{toml_key(name)} = {text}" + (f" # {units[name]}" if units[name] else ""))
    return "\n".join(lines)


def percent(share: float, digits: int = 0) -> str:
    """A fraction as text in per cent, such as "12 %", with so many decimals."""
    return f"{100 * share:.{digits}f} %"


def _each(values: Any, form: str | None = None) -> str:
    """The numbers of an array as text, separated by commas; each by the %-format `form`, or with four significant
    digits.
    """
    return ", ".join(number(v) if form is None else form % v for v in np.ravel(values))


def _listed(names: Iterable[str | None]) -> str:
    """Names in double quotation marks, separated by commas."""
    return ", ".join(f'"{name}"' for name in names)
