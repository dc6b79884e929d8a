"""Results of the robustness check: result.json, both population maps, figures, and a self-contained page."""

from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import xarray as xr

from hilbo.hyperparameters.judged_evidence import judged_sentences
from hilbo.population.rules.registry import RECOMMENDED
from hilbo.report.page import Pictures, rendered
from hilbo.report.result_file import write_result
from hilbo.report.results import optimum_content, save_figures, versions
from hilbo.study.analysis.robustness import LIMIT, Robustness
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.formats.json_file import Content
from hilbo.study.results.map_netcdf import map_dataset

__all__ = ["robustness_page", "robustness_result", "write_robustness"]

_TENTH = 0.1  # of every search range: two renderings that a person would hardly tell apart
_UNRELATED = 0.1


def write_robustness(
    study: Study, cohort: Cohort, check: Robustness, folder: Path, seed: int = 0, left_out: Sequence[str] = ()
) -> Content:
    """Write result.json, map.nc (both maps), the figures and report.html into an existing folder; return the content of
    result.json.

    `left_out`: sentences on excluded participants, which become the first warnings; `seed`: only recorded.
    """
    content = robustness_result(study, cohort, check, seed)
    content["warnings"] = [*left_out, *content["warnings"]]
    write_result(content, folder)
    maps = [map_dataset(study, lambda x, of=of: of(jnp.asarray(x))) for of in check.maps()]
    both = xr.concat(maps, xr.DataArray(["fixed", "by evidence"], dims="hyperparameters", name="hyperparameters"))
    both.to_netcdf(folder / "map.nc", engine="h5netcdf")
    pictures = save_figures(_figures(study, cohort, check), folder)
    (folder / "report.html").write_text(robustness_page(study, content, pictures), encoding="utf-8")
    return content


def robustness_page(study: Study, content: Content, figures: Pictures) -> str:
    """The page of the robustness check as HTML, with its figures inside. `content`: of `robustness_result`; `figures`:
    of `save_figures`.
    """
    # Of each hyperparameter a list of columns: how each parameter moves with it, in search ranges.
    sensitivity = {name: np.atleast_2d(np.asarray(block).T) for name, block in content["sensitivity"].items()}
    return rendered(
        "robustness.html",
        study=study,
        content=content,
        warnings=content["warnings"],
        figures=figures,
        limit=LIMIT,
        recommended=RECOMMENDED,
        sensitivity=sensitivity,
        table=_table(content["learned"]) if content["learned"]["shared"] else None,
    )


def _table(learned: Content) -> str:
    """The learnt hyperparameters as a [gp] table of a study file, TOML text with four significant digits."""
    names = ("theta", "variance", "thresholds", "noise")
    return "\n".join(["[gp]", *(f"{name} = {_four_digits(learned[name])}" for name in names)])


def _four_digits(value: float | list[float]) -> str:
    """A number, or a list of numbers, as TOML text with four significant digits."""
    return f"[{', '.join(map(_four_digits, value))}]" if isinstance(value, list) else repr(float(f"{value:.4g}"))


def _figures(study, cohort, check):
    """Matplotlib figures: "maps", under fixed and under learnt hyperparameters, and "moves", shifts of the optima."""
    from hilbo.report.figures import maps

    fixed, optimised = check.maps()
    both = {"fixed hyperparameters": fixed, "by maximum evidence": optimised}
    return {
        "maps": maps.maps_beside(study, both, np.stack([check.fixed.x, check.optimised.x])),
        "moves": maps.moved_optima(cohort.names, check.individual_nrmse, float(check.nrmse), LIMIT),
    }


def robustness_result(study: Study, cohort: Cohort, check: Robustness, seed: int) -> Content:
    """The content of result.json of `hilbo robustness`, without excluded participants' sentences.

    Both optima, their distance (NRMSE), that of each participant, the learnt hyperparameters, and the optimum's
    derivatives by them. `seed`: only recorded.
    """
    maximum, people = check.maximum, len(cohort.names)
    stacked = [np.broadcast_to(np.asarray(flags), (people,)) for flags in (maximum.converged, maximum.runaway)]
    rows = [
        {
            "participant": name,
            "nrmse": float(check.individual_nrmse[j]),
            "flagged": bool(check.flagged_individuals[j]),
            "converged": bool(stacked[0][j]),
            "runaway": bool(stacked[1][j]),
        }
        for j, name in enumerate(cohort.names)
    ]
    model = maximum.gp
    return {
        "warnings": _warnings(check, stacked),
        "fixed": optimum_content(study, check.fixed),
        "optimised": optimum_content(study, check.optimised),
        "nrmse": float(check.nrmse),
        "flagged": bool(check.flagged),
        "resampled": None if check.resampled is None else _percentiles(check.resampled),
        "rule": check.rule,
        "participants": rows,
        "learned": {
            "parameters": list(maximum.learn),
            "laplace_error": np.asarray(check.judged.error).tolist(),
            "learnt_again": np.asarray(check.judged.again).tolist(),
            "shared": check.shared,
            "theta": np.asarray(model.kernel.theta).tolist(),
            "variance": np.asarray(model.kernel.variance).tolist(),
            "noise": np.asarray(model.likelihood.noise).tolist(),
            "thresholds": np.asarray(model.likelihood.thresholds).tolist(),
        },
        "sensitivity": {name: np.asarray(block).tolist() for name, block in check.sensitivity.items()},
        "study": study.file.hash,
        "seed": seed,
        "versions": versions(),
    }


def _percentiles(draws):
    """Median and 95th percentile of numbers, under the keys "median" and "95 %"."""
    return dict(zip(("median", "95 %"), np.percentile(draws, [50, 95]).tolist(), strict=True))


def _warnings(check, stacked):
    """Warnings about the learnt hyperparameters, as sentences: a correlation length below a tenth of a search range,
    searches that did not converge or ran away, and an inaccurate Laplace evidence.

    `stacked`: flags (M,) of converged and of runaway searches, of each participant.
    """
    converged, runaway = stacked
    kernel = check.maximum.gp.kernel
    of_numbers = np.array(kernel.levels) == 0 if kernel.levels else ...
    theta = float(np.median(np.asarray(kernel.theta)[of_numbers]))
    alike = float(np.exp(-theta * _TENTH**2))
    sentences = []
    if alike < _UNRELATED:
        sentences.append(
            f"Under the learnt theta = {theta:.3g}, renderings a tenth of a search range apart have a correlation of"
            f" {alike:.2g}: the answers do not make a smooth map, and an optimum found with it says little."
        )
    for state, words in ((~converged, "did not converge"), (runaway, "found no maximum of the evidence in reach")):
        if state.any():
            whose = "The search" if check.shared else f"{state.sum()} of {len(state)} searches"
            sentences.append(f"{whose} for hyperparameters {words}.")
    return sentences + judged_sentences(check.judged)
