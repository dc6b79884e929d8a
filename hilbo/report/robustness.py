"""Results of the robustness check: result.json, both population maps, figures, and a self-contained page."""

from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import xarray as xr

from hilbo.population.rules.registry import RULES
from hilbo.report.page import Pictures, rendered
from hilbo.report.result_file import write_result
from hilbo.report.results import optimum_content, save_figures, versions
from hilbo.study.analysis.heterogeneity import how_aggregated
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import Aggregate, Surface
from hilbo.study.estimate.learnt import learnt_sentences
from hilbo.study.estimate.location import location_notes
from hilbo.study.formats.json_file import Content
from hilbo.study.results.map_netcdf import map_dataset
from hilbo.study.robustness.pilot import Pilot
from hilbo.study.robustness.robustness import LIMIT, NEAR, Place, Robustness

__all__ = ["gp_table", "robustness_page", "robustness_result", "write_robustness"]

_TENTH = 0.1  # of every search range: distance of two hardly discriminable stimuli
_UNRELATED = 0.1


def write_robustness(
    study: Study,
    cohort: Cohort,
    check: Robustness,
    folder: Path,
    seed: int = 0,
    left_out: Sequence[str] = (),
    pilot: Pilot | None = None,
) -> Content:
    """Write result.json, map.nc (both maps), the figures and report.html into an existing folder; return the content of
    result.json.

    `left_out`: sentences on excluded participants, which become the first warnings; `seed`: only recorded; `pilot`:
    intervals of the optimised hyperparameters.
    """
    content = robustness_result(study, cohort, check, seed, pilot)
    content["warnings"] = [*left_out, *content["warnings"]]
    write_result(content, folder)
    maps = [map_dataset(study, lambda x, of=of: of(jnp.asarray(x))) for of in _maps(check)]
    both = xr.concat(maps, xr.DataArray(["fixed", "by evidence"], dims="hyperparameters", name="hyperparameters"))
    both.to_netcdf(folder / "map.nc", engine="h5netcdf")
    pictures = save_figures(_figures(study, cohort, check), folder)
    (folder / "report.html").write_text(robustness_page(study, content, pictures), encoding="utf-8")
    return content


def _maps(check: Robustness) -> tuple[Surface, Surface]:
    """Population maps with fixed and with optimised hyperparameters."""
    return check.fixed_aggregate.surface, check.optimised_aggregate.surface


def robustness_page(study: Study, content: Content, figures: Pictures) -> str:
    """The page of the robustness check as HTML, with its figures inside. `content`: of `robustness_result`; `figures`:
    of `save_figures`.
    """
    # Of each hyperparameter a list of columns: how each parameter moves with it, in search ranges.
    blocks = content["sensitivity"] or {}
    return rendered(
        "robustness.html",
        study=study,
        content=content,
        warnings=content["warnings"],
        figures=figures,
        limit=LIMIT,
        near=NEAR,
        top=study.goal_label,
        learns=RULES[study.rule].learns,
        predicts=RULES[study.rule].predicts,
        sensitivity={name: np.atleast_2d(np.asarray(block).T) for name, block in blocks.items()},
        how=content["aggregated"],
        table=None if study.gp.kernel.levels else gp_table(content),
    )


def gp_table(content: Content) -> str:
    """The optimised hyperparameters as a [gp] table of a study file, TOML text with four significant digits; with a
    pilot's intervals as comments. `content`: of `write_robustness`."""
    learned, pilot = content["learned"], content["pilot"]
    intervals = pilot["intervals"] if pilot else {}
    lines = ["[gp]"]
    if pilot:
        lines[0] = f"[gp] # estimated from {pilot['participants']} participants; 95 % intervals: delete-one jackknife"
    for name in ("theta", "variance", "thresholds", "noise"):
        ends = ", ".join(f"{low:.3g} to {high:.3g}" for low, high in intervals.get(name, []))
        remark = f"95 %: {ends}" if ends else "as in the study file"
        lines.append(f"{name} = {_four_digits(learned[name])}" + (f" # {remark}" if pilot else ""))
    if content["inference"] != "laplace":
        lines.append(f'inference = "{content["inference"]}"')
    return "\n".join(lines)


def _unfinished(pilot: Pilot) -> list[str]:
    """A sentence on searches of the jackknife that did not converge, if any."""
    if not pilot.unfinished:
        return []
    names = ", ".join(pilot.unfinished)
    return [f"The intervals of the hyperparameters are rough: without {names} the search for them did not converge."]


def _pilot_content(pilot: Pilot) -> Content:
    """A pilot as an entry of result.json."""
    intervals = {name: ends.tolist() for name, ends in pilot.intervals.items()}
    return {"participants": pilot.participants, "intervals": intervals, "unfinished": list(pilot.unfinished)}


def _four_digits(value: float | list[float]) -> str:
    """A number, or a list of numbers, as TOML text with four significant digits."""
    return f"[{', '.join(map(_four_digits, value))}]" if isinstance(value, list) else repr(float(f"{value:.4g}"))


def _figures(study, cohort, check):
    """Matplotlib figures: "maps", under fixed and under optimised hyperparameters, and "moves", shifts of the
    optima.
    """
    from hilbo.report.figures import maps

    fixed, optimised = _maps(check)
    both = {"fixed hyperparameters": fixed, "by maximum evidence": optimised}
    best = np.stack([check.fixed.optimum.x, check.optimised.optimum.x])
    return {
        "maps": maps.maps_beside(study, both, best, own_scales=True),
        "moves": maps.moved_optima(cohort.names, check.individual_nrmse, check.nrmse, LIMIT),
    }


def robustness_result(
    study: Study, cohort: Cohort, check: Robustness, seed: int, pilot: Pilot | None = None
) -> Content:
    """The content of result.json of `hilbo robustness`, without excluded participants' sentences.

    The optima and their distances (NRMSE), that of each participant, the optimised hyperparameters and their criterion,
    and the optimum's derivatives by them. `seed`: only recorded; `pilot`: intervals of the optimised hyperparameters.
    """
    both = check.hyperparameters
    model = both.optimised.gp
    moves = zip(cohort.names, check.individual_nrmse.tolist(), strict=True)
    resampled = check.resampled
    return {
        "warnings": [*_warnings(check), *(_unfinished(pilot) if pilot else ())],
        "fixed": _place_content(both.fixed, check.fixed_aggregate, check.fixed),
        "optimised": _place_content(both.optimised, check.optimised_aggregate, check.optimised),
        "local": check.local and _place_content(both.optimised, check.optimised_aggregate, check.local),
        "fixed_again": _place_content(both.optimised, check.optimised_aggregate, check.fixed_again),
        "nrmse": check.nrmse,
        "local_nrmse": check.local_nrmse,
        "flagged": check.flagged,
        "resampled": None if resampled is None else _percentiles(resampled.fixed),
        "resampled_moves": None if resampled is None else _percentiles(resampled.moves),
        "rule": study.rule,
        "aggregated": how_aggregated(check.fixed_aggregate.map),
        "participants": [{"participant": name, "nrmse": move, "flagged": move >= LIMIT} for name, move in moves],
        "learned": {
            "criterion": both.criterion,
            "gain": both.gain,
            "parameters": list(both.learn),
            "converged": both.converged,
            "runaway": both.runaway,
            "theta": np.asarray(model.kernel.theta).tolist(),
            "variance": np.asarray(model.kernel.variance).tolist(),
            "noise": np.asarray(model.likelihood.noise).tolist(),
            "thresholds": np.asarray(model.likelihood.thresholds).tolist(),
        },
        "inference": study.inference,
        "pilot": pilot and _pilot_content(pilot),
        "sensitivity": check.sensitivity and {name: np.asarray(v).tolist() for name, v in check.sensitivity.items()},
        "study": study.file.hash,
        "seed": seed,
        "versions": versions(),
    }


def _place_content(study: Study, aggregate: Aggregate, place: Place) -> Content:
    """An optimum of an aggregate's map as an entry of result.json, with the responses near it, and whether it lies on a
    limit or is an extrapolation.
    """
    near = {"answers": place.answers, "highest": place.highest}
    location = location_notes(study, place.optimum.x, place.optimum.sd, aggregate.asked_variance)
    return optimum_content(study, place.optimum) | {"near": near, "location": location}


def _correlation(study: Study) -> float:
    """Correlation of the latent function a tenth of a search range apart, the median over numeric parameters; 1 without
    any.
    """
    kernel, middle = study.gp.kernel, np.full(study.space.dim, 0.5)
    numeric = [i for i, parameter in enumerate(study.space.parameters) if not parameter.categorical]
    steps = _TENTH * np.eye(study.space.dim)[numeric]
    pairs = [kernel(jnp.asarray(middle), jnp.asarray(middle + step)) / kernel.variance for step in steps]
    return float(np.median(pairs)) if pairs else 1.0


def _percentiles(draws):
    """Median and 95th percentile of numbers, under the keys "median" and "95 %"."""
    return dict(zip(("median", "95 %"), np.percentile(draws, [50, 95]).tolist(), strict=True))


def _warnings(check):
    """Warnings as a list of sentences: a correlation below 0.1 between points a tenth of a search range apart, a goal
    that is not the most probable response at the optimised optimum, and those on the search and the learnt model.
    """
    both = check.hyperparameters
    alike, sentences = _correlation(both.optimised), []
    if alike < _UNRELATED:
        sentences.append(
            f"Under the optimised hyperparameters two stimuli at a distance of a tenth of a search range have a"
            f" correlation of {alike:.2g}: the map is not smooth, and its optimum is unreliable."
        )
    chances = np.asarray(check.optimised.optimum.class_probabilities)
    goal = both.optimised.goal.category
    if np.argmax(chances) != goal:
        sentences.append(
            f'Under the optimised hyperparameters "{both.optimised.goal_label}" is not the most probable response of'
            f" a new participant, even at the optimum ({100 * chances[goal]:.0f} %)."
        )
    return [*sentences, *both.limits, *learnt_sentences(both.optimised)]
