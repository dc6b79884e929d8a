"""Results of `hilbo identify` and `hilbo passivity`: result.json, the [renderer] block, figures, a page.

A table shows digits only of identified parameters, and else their status in words. `set` in result.json always has the
numbers of the best curve, which belong together and to their N and T.
"""

import math
from pathlib import Path
from typing import Any

import pandas as pd

from hilbo.identification.characterise import Characterisation
from hilbo.identification.fitting import Test
from hilbo.identification.memory_selection import LIMIT, PAPER, smallest
from hilbo.identification.sampled import Sampled
from hilbo.report.page import rendered
from hilbo.report.passivity import passivity_words
from hilbo.report.result_file import write_result
from hilbo.report.results import save_figures, versions
from hilbo.viscoelastic import FOSLS

__all__ = ["identification_result", "reference_row", "renderer_block", "write_identification", "write_passivity"]


def identification_result(
    source: str,
    tests: tuple[Test, ...],
    result: Characterisation,
    unit: str,
    notes: tuple[str, ...],
    damping: float | None,
) -> dict[str, Any]:
    """The content of result.json of `hilbo identify`, ready for JSON.

    `source`: where the data are from; `unit`: of the curves; `notes`: warnings put before those of the result;
    `damping`: the device's, N·s/m, None if not known. A parameter that is not identified has the value None; `renderer`
    is None unless the model is the sampled one; `passivity`, `bootstrap` and `smallest_N` are None where the result has
    none.
    """
    model = result.fit.model
    sampled = isinstance(model, Sampled)
    about: dict[str, Any] = {"name": type(model).__name__.lower() if not sampled else "fosls", "unit": unit}
    if sampled:
        about |= {"memory": model.memory, "N": int(model.N) if model.memory == "short" else None, "T": model.T}
    content = {
        "source": source,
        "model": about,
        "parameters": {
            name: {
                "value": estimate.value if estimate.known else None,
                "lower": estimate.lower,
                "upper": estimate.upper,
                "status": estimate.status,
            }
            for name, estimate in result.estimates.items()
        },
        "set": result.fit.parameters(),
        "nrmse": result.nrmse,
        "residuals": result.noise,
        "bootstrap": None if result.bootstrap is None else {k: list(v) for k, v in result.bootstrap.items()},
        "memory": [_memory_entry(row) for row in result.rows],
        "smallest_N": None if (best := smallest(result.rows)) is None else best.N,
        "passivity": None if result.minimum_damping is None else _passivity(result.minimum_damping, damping),
        "renderer": renderer_block(result, damping) if sampled else None,
        "tests": {test.kind: {"points": test.time.size, "repeats": test.repeats} for test in tests},
        "warnings": [*notes, *result.warnings],
        "versions": versions(),
    }
    return content


def _memory_entry(row):
    """Entry of `memory` in result.json for the fit with one memory length: N (None: full memory), NRMSE by test,
    set.
    """
    return {"N": row.N, "memory": "full" if row.N is None else "short", "nrmse": row.nrmse, "set": row.fit.parameters()}


def _passivity(needed, damping):
    """Entry `passivity` of result.json: needed damping, the device's damping, and their difference, N·s/m.

    `damping` None (not known): so is the margin.
    """
    margin = None if damping is None else damping - needed
    return {"minimum_damping": needed, "damping": damping, "margin": margin}


def renderer_block(result: Characterisation, damping: float | None) -> str:
    """The [renderer] table of a study file for this material, as TOML text; the whole parameter set as comments.

    The line of K_eff always has the value of the best curve; its status is a comment beside it. `damping`: the
    device's, N·s/m; None leaves a commented line to fill in. The model must be the sampled one (`Sampled`).
    """
    model, values = result.fit.model, result.fit.parameters()
    lines = ["[renderer]", 'model = "fosls"', f'memory = "{model.memory}"']
    if model.memory == "short":
        lines.append(f"N = {int(model.N)}")
    worth = result.estimates["K_eff"].status
    lines += [f"T = {float(model.T)!r}             # s", f"K_eff = {values['K_eff']:.6g}       # N/mm, {worth}"]
    needed = result.minimum_damping
    note = "" if needed is None else f"; this set needs at least {needed:.4g}"
    if damping is None:
        lines.append(f"# damping =           # N.s/m, a property of your device: measure it{note}")
    else:
        lines.append(f"damping = {float(damping)!r}       # N.s/m{note}")
    lines += ["# The set itself, for this N and T only:"]
    lines += [f"#   {name} = {values[name]:.6g}" for name in ("K0", "K1", "B1", "alpha")]
    return "\n".join(lines) + "\n"


def write_identification(
    tests: tuple[Test, ...],
    result: Characterisation,
    content: dict[str, Any],
    folder: Path,
    damping: float | None,
    material: str | None = None,
) -> None:
    """Write the results of `hilbo identify` into an existing folder: result.json, curves.csv, figures, report.html.

    For the sampled model renderer.toml, sets.csv (`reference_row`) and the figures of its set too. `content`: of
    `identification_result`; `damping`: the device's, N·s/m; None: the figures are drawn for the damping that the set
    needs; `material`: as for `reference_row`.
    """
    from hilbo.report.figures import mechanics as plotting

    write_result(content, folder)
    _curves(tests, result, plotting.predicted).to_csv(folder / "curves.csv", index=False)
    figures = {"tests": plotting.curves_figure(tests, result, content["model"]["unit"])}
    if result.rows:
        figures["memory"] = plotting.memory_figure(result.rows)
    if content["renderer"] is not None:
        (folder / "renderer.toml").write_text(content["renderer"])
        reference_row(result, material).to_csv(folder / "sets.csv", index=False)
        figures |= _set_figures(_model(result), damping or result.minimum_damping)
    page = rendered(
        "material.html",
        content=content,
        warnings=content["warnings"],
        parameters=[_parameter(name, estimate, result.bootstrap) for name, estimate in result.estimates.items()],
        limit=LIMIT,
        paper=PAPER,
        verdict="",
        figures=save_figures(figures, folder),
    )
    (folder / "report.html").write_text(page, encoding="utf-8")


def reference_row(result: Characterisation, material: str | None) -> pd.DataFrame:
    """A sets table with one set of source sysid: the parameters of the best curve with their 95 % profile intervals
    (NAME_low, NAME_high; empty where an end is open), and how they are rendered. The model must be the sampled one.
    `material`: its name, which begins the set's and fills a column; None for a study without materials.
    """
    model, values = result.fit.model, result.fit.parameters()
    row: dict[str, Any] = {"set_id": f"{material} sysid" if material else "sysid", "source": "sysid"}
    row |= {"material": material} if material else {}
    for name in ("K0", "K1", "B1", "alpha"):
        row[name] = values[name]
    for name in ("K1", "B1", "alpha"):
        row[f"{name}_low"], row[f"{name}_high"] = result.estimates[name][1:3]
    short = model.memory == "short"
    row |= {"N": int(model.N) if short else None, "T": float(model.T), "memory": model.memory}
    return pd.DataFrame([row])


def _model(result):
    """The fitted parameter set as `FOSLS`, with the T and the memory of the fit; for the sampled model."""
    values, model = result.fit.parameters(), result.fit.model
    place = (values[name] for name in ("K0", "K1", "B1", "alpha"))
    if model.memory == "full":
        return FOSLS(*place, T=model.T, memory="full")
    return FOSLS(*place, N=int(model.N), T=model.T)


def _set_figures(model, b, delay=0.0):
    """Matplotlib figures of one parameter set by name: always "bode"; with a damping `b` (N·s/m) also "passivity" and,
    for odd N and full memory, "passive-set". `delay`: of the force, s.
    """
    from hilbo.report.figures import mechanics as plotting

    figures = {"bode": plotting.bode_figure(model)}
    if b is not None:
        figures["passivity"] = plotting.passivity_figure(model, b, delay)
        if model.memory == "full" or model.N % 2:
            figures["passive-set"] = plotting.passive_set_figure(model, b, float(model.dc_gain()), delay)
    return figures


def _curves(tests, result, predicted):
    """The table curves.csv: for each kind of test its times (s), mean of the repeats, their sd if there are several,
    and the fitted curve. `predicted`: fit and kind of test -> curve.
    """
    parts = []
    for test in tests:
        columns = {"test": test.kind, "time_s": test.time, "mean": test.output.mean(axis=0)}
        if test.repeats > 1:
            columns["sd"] = test.output.std(axis=0, ddof=1)
        parts.append(pd.DataFrame(columns | {"fit": predicted(result.fit, test.kind)}))
    return pd.concat(parts, ignore_index=True)


def _parameter(name, estimate, bootstrap):
    """Row of the page's table for a parameter: its value, or its status if it is not identified; profile interval, and
    bootstrap interval. All are rounded texts.

    "open" stands for an interval end that is None; an interval is None if there is none.
    """
    value = _rounded(estimate.value, estimate.lower, estimate.upper) if estimate.known else estimate.status
    ends = [_rounded(end, estimate.lower, estimate.upper) if end is not None else "open" for end in estimate[1:3]]
    resampled = (bootstrap or {}).get(name) if estimate.known else None
    return {
        "name": name,
        "value": value,
        "interval": None if estimate.lower is None and estimate.upper is None else ends,
        "bootstrap": None if resampled is None else [_rounded(end, *resampled) for end in resampled],
    }


def _rounded(value, lower, upper):
    """A value as text with so many decimals that the width of its interval has two digits; three significant digits for
    an open or empty interval.
    """
    if lower is None or upper is None or not upper > lower:
        return f"{value:.3g}"
    decimals = max(0, 1 - math.floor(math.log10(upper - lower)))
    return f"{value:.{decimals}f}"


def write_passivity(model: FOSLS, content: dict[str, Any], folder: Path) -> None:
    """Write result.json, the figures of the set and report.html into an existing folder. `content`: of
    `passivity_result`.
    """
    write_result(content, folder)
    page = rendered(
        "material.html",
        content=content | {"versions": versions()},
        warnings=[],
        verdict=passivity_words(content),
        figures=save_figures(_set_figures(model, content["damping"], content["delay"]), folder),
    )
    (folder / "report.html").write_text(page, encoding="utf-8")
