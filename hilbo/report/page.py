"""Pages around the numbers of results: Jinja templates of this folder, which hold the words, and their filters."""

from collections.abc import Iterable
from functools import cache
from itertools import islice
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape

from hilbo.population.rules.registry import RULES
from hilbo.report.kernel_words import covariance_words, formula
from hilbo.report.participants import People
from hilbo.study.config import Study

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
    """The page of an aggregation.

    **Arguments:** `how`: how maps of fewer trials are aggregated, where it is not as the map is; `drawn`: of a large
    population, how many `participants` and individual `optima` its figures show; `selection`: how what was asked had
    been chosen, where that is known; `comparison`: the section of `report.comparison`; `halves`: into
    how many halves people were split to say how sure the optimum after fewer trials is.
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
    """What an estimate of the optimum is called on pages; `name`: its key in result.json, `rule`: the study's."""
    return f"population map ({rule})" if name == "aggregate" else _ESTIMATES[name]


def rendered(name: str, **facts: Any) -> str:
    """The page of a template, which escapes what it is given."""
    return _environment().get_template(name).render(**facts)


def text_of(name: str, **facts: Any) -> str:
    """The Markdown of a template, in which lines with nothing but tags leave none."""
    lines = _environment().overlay(trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True)
    return lines.get_template(name).render(**facts)


@cache
def _environment() -> Environment:
    """Templates with their filters; a name that a template misses is an error."""
    environment = Environment(
        loader=PackageLoader("hilbo.report"), autoescape=select_autoescape(), undefined=StrictUndefined
    )
    environment.filters |= {
        "number": number,
        "extent": _extent,
        "percent": percent,
        "symbol": _symbol,
        "unit": _unit,
        "each": _each,
        "listed": _listed,
    }
    environment.globals |= {"heads": heads, "zip": zip, "estimate_words": estimate_words}
    environment.globals |= {"covariance_words": covariance_words, "formula": formula}
    return environment


def heads(study: Study, names: Iterable[str]) -> list[str]:
    """Parameters with their units, as heads of columns."""
    units = {"K0": "N/mm"} | {p.name: p.unit for p in study.space.parameters}
    return [f"{_symbol(name)} ({_unit(units[name])})" if units[name] else _symbol(name) for name in names]


def _symbol(name: str) -> str:
    return "α" if name == "alpha" else name


def _unit(unit: str) -> str:
    return unit.replace("^alpha", "^α").replace("s^α", "sᵅ").replace(".", "·")


def number(value: float | str) -> str:
    """Four significant digits, never with an exponent; the name of a level as it is."""
    if isinstance(value, str):
        return value
    return np.format_float_positional(value, precision=4, unique=False, fractional=False, trim="-")


def _extent(values: list[float | str]) -> str:
    """From which end to which a parameter's values go, or which levels are among them."""
    if isinstance(values[0], str) or values[0] == values[1]:
        return "= " + " or ".join(map(number, dict.fromkeys(values)))
    return f"from {number(values[0])} to {number(values[1])}"


def percent(share: float, digits: int = 0) -> str:
    """A share in per cent."""
    return f"{100 * share:.{digits}f} %"


def _each(values: Any, form: str | None = None) -> str:
    """Numbers of an array in a row, each by its form, or with four significant digits."""
    return ", ".join(number(v) if form is None else form % v for v in np.ravel(values))


def _listed(names: Iterable[str | None]) -> str:
    """Names in quotation marks, in a row."""
    return ", ".join(f'"{name}"' for name in names)
