"""Results as self-contained HTML pages: the words and tables around the numbers of result.json."""

from itertools import islice
from typing import Any

import numpy as np

from hilbo.report.participants import People
from hilbo.study.config import Study

_RULES = {
    "ucb": "by the upper confidence bound",
    "log_ei": "by expected improvement",
    "thompson": "by Thompson sampling",
    "top_category": "by the probability of the highest answer",
    "mean": "by the posterior mean",
}

_SHOWN = 200  # participants in the page's table

__all__ = ["results_page", "robustness_page", "template"]


def results_page(study: Study, content: dict[str, Any], pictures: list[dict[str, str]], people: People) -> str:
    """The page of an aggregation; `pictures` have png (base64), title, caption and alt."""
    sheet = template("report.html")
    best, gp = content["optimum"], study.gp
    count, answers = len(people.names), int(people.trials.sum())
    worst = float(people.certificate["residual"].max())
    return sheet.render(
        title=f"{study.name}: the population's optimum",
        lead=f"{count:,} participants gave {answers:,} answers ({', '.join(study.responses)}). Each person's"
        f" answers were turned into a map of {study.attribute}; the maps were merged, and this is where the merged map"
        " is highest.",
        warnings=content["warnings"],
        study_rows=_study_rows(study),
        optimum=[(_head(study, name), _number(value)) for name, value in best["parameters"].items()],
        probabilities=[(label, f"{100 * p:.0f} %") for label, p in best["class_probabilities"].items()],
        attribute=study.attribute,
        realism=f"{best['mean']:.2f} ± {best['sd']:.2f} (mean and standard deviation of f)",
        passivity=_passivity_words(best["passivity_margin"]),
        **_comparison(study, content),
        figures=pictures,
        people_head=["participant", "trials", *(_head(study, n) for n in best["parameters"]), "f", "sd"],
        people=[] if people.sets is None else [_person(entry) for entry in islice(people.entries(), _SHOWN)],
        people_words=_people_words(people),
        variance=f"{float(gp.kernel.variance):g}",
        theta=", ".join(f"{t:g}" for t in np.atleast_1d(np.asarray(gp.kernel.theta))),
        noise=f"{float(gp.likelihood.noise):g}",
        thresholds=", ".join(f"{float(t):g}" for t in gp.likelihood.thresholds),
        search=_search_words(study),
        rule=content["rule"],
        method=_METHODS[study.inference],
        certificate=_CERTIFICATES[study.inference].format(worst=f"{worst:.1e}"),
        other=_other_words(study, content),
        study_hash=content["study"],
        seed=content["seed"],
        versions=", ".join(f"{k} {v}" for k, v in content["versions"].items()),
    )


def _person(entry):
    best = entry["optimum"]
    values = (_number(v) for v in best["parameters"].values())
    return [entry["participant"], entry["trials"], *values, f"{best['mean']:.2f}", f"{best['sd']:.2f}"]


def _people_words(people):
    """What the table of participants leaves out."""
    if people.sets is None:
        return "Their own optima were not sought; result.json has their certificates."
    if len(people.names) > _SHOWN:
        return f"The first {_SHOWN} of {len(people.names):,}; all are in result.json and optima.csv."
    return ""


def _head(study, name):
    unit = _unit({p.name: p.unit for p in study.space.parameters}.get(name, "N/mm" if name == "K0" else ""))
    name = {"alpha": "α"}.get(name, name)
    return f"{name} ({unit})" if unit else name


def _number(value):
    """Four significant digits, never with an exponent."""
    return np.format_float_positional(value, precision=4, unique=False, fractional=False, trim="-")


def _unit(unit):
    return unit.replace("^alpha", "^α").replace("s^α", "sᵅ").replace(".", "·")


def _study_rows(study):
    """What was studied, as pairs of words."""
    for p in study.space.parameters:
        scale = ", on a logarithmic scale" if p.scale == "log" else ""
        yield {"alpha": "α"}.get(p.name, p.name), f"{p.low:g} to {p.high:g} {_unit(p.unit)}".strip() + scale
    yield "answers, lowest first", ", ".join(study.responses)
    chosen = study.selection
    yield (
        "trials",
        f"{chosen.trials}, the first {chosen.space_filling} spread evenly, then {_RULES[chosen.acquisition]}",
    )
    mechanics = study.space.mechanics
    if mechanics is not None:
        model = (
            f"FO-SLS, {_memory(mechanics)}, T = {1000 * mechanics.T:g} ms, effective stiffness {mechanics.K_eff:g} N/mm"
        )
        yield "renderer", f"{model}; the device has {mechanics.damping:g} N·s/m of damping"


def _memory(mechanics):
    return f"N = {mechanics.N}" if mechanics.memory == "short" else f"full memory, {mechanics.states} exponentials"


_METHODS = {
    "laplace": "a Gaussian at its mode (Laplace)",
    "ep": "a Gaussian with the moments of expectation propagation",
    "ep_corrected": "a Gaussian with the moments of expectation propagation, corrected to second order",
    "exact": "sampled exactly (minimax tilting) and enters with its mean and variance",
}
_CERTIFICATES = {
    "laplace": "Certificates: every mode was found by Newton's method to a residual of at most {worst} prior standard"
    " deviations (which bounds its distance from the exact mode).",
    "ep": "Certificates: the moments of every fit agree to {worst} (means in prior standard deviations, or logarithms"
    " of variances).",
    "ep_corrected": "Certificates: the moments of every fit agreed to {worst} (means in prior standard deviations, or"
    " logarithms of variances) before they were corrected.",
    "exact": "Certificates: the largest standard error of a latent mean (in prior standard deviations) or of a log"
    " evidence is {worst}.",
}


def _other_words(study, content):
    """By how much the optimum would move with another inference; nothing if it was not computed."""
    other = content.get("other_inference")
    if other is None:
        return ""
    name = {"ep": "expectation propagation", "laplace": "Laplace's approximation"}[other["inference"]]
    ways = [
        f"{_head(study, parameter)} by {way['by']:+.3g} ({way['percent']:+.1f} % of its range)"
        for parameter, way in other["moved"].items()
    ]
    whole = f"the optimum would move by {100 * other['nrmse']:.1f} % of the search ranges (NRMSE)"
    return f"With {name} instead, {whole}: {', '.join(ways)}."


def _passivity_words(margin):
    if margin is None:
        return ""
    kind = "passive" if margin >= 0 else "not passive"
    by = f"{abs(margin):.3f} N·s/m {'more' if margin >= 0 else 'less'} damping than it needs"
    return f"The rendering is {kind} on the study's device, which has {by}."


def _search_words(study):
    mechanics = study.space.mechanics
    if mechanics is None:
        return "The optimum was searched over the whole box."
    return (
        f"The optimum was searched among the passive parameter sets (FO-SLS, {_memory(mechanics)},"
        f" T = {1000 * mechanics.T:g} ms, device damping {mechanics.damping:g} N·s/m less 0.1 %), with K0 from the"
        f" effective stiffness {mechanics.K_eff:g} N/mm."
    )


def _comparison(study, content):
    """Rows: what else one might ship, with its passivity and, where the truth is known, its miss."""
    truth = content.get("truth")
    claims = {f"population map ({content['rule']})": ("aggregate", content["optimum"])}
    words = {"average": "plain average of the latent functions", "pooled": "one model of all answers"}
    words |= {"ep": "population map, expectation propagation", "laplace": "population map, Laplace"}
    words |= {"hierarchical": "people who differ (hierarchical)", "bcm": "committee machine (bcm)"}
    claims |= {words[name]: (name, optimum) for name, optimum in content["alternatives"].items()}
    if content["mean_of_optima"] is not None:
        claims["mean of the individual optima"] = ("mean_of_optima", content["mean_of_optima"])
    rows = []
    for words_, (name, optimum) in claims.items():
        row = [words_, *(_number(v) for v in optimum["parameters"].values())]
        if optimum["passivity_margin"] is not None:
            row.append(f"{optimum['passivity_margin']:+.3f}")
        if truth:
            row.append(f"{100 * truth['nrmse'][name]['nrmse']:.1f} %")
        rows.append(row)
    head = ["", *(_head(study, n) for n in content["optimum"]["parameters"])]
    head += ["passivity margin (N·s/m)"] if content["optimum"]["passivity_margin"] is not None else []
    caption = "Other ways to choose one rendering for all"
    caption += "." if content["optimum"]["passivity_margin"] is None else "; a negative margin is not passive."
    if truth:
        head.append("miss (NRMSE)")
        rows.append(
            [
                "truth",
                *(_number(v) for v in truth["parameters"].values()),
                *[""] * (len(head) - len(truth["parameters"]) - 1),
            ]
        )
        q = [f"{100 * v:.0f}" for v in truth["individuals"]["quartiles"]]
        caption += f" The individuals' own optima miss the truth by {q[1]} % (median; quartiles {q[0]} and {q[2]} %)."
    return {"comparison": rows, "comparison_head": head, "comparison_caption": caption}


def robustness_page(study: Study, content: dict[str, Any], pictures: list[dict[str, str]]) -> str:
    """One self-contained page of the robustness check."""
    learned, versions = content["learned"], content["versions"]
    whose = "one set for all" if learned["shared"] else "each person's own"
    return template("robustness.html").render(
        title=f"{study.name}: robustness to the hyperparameters",
        lead="The optima were found twice: under the study's fixed hyperparameters, and under those by maximum evidence"
        f" with weak priors ({whose}; learnt: {', '.join(learned['parameters'])}). People were merged point by point by"
        f" the rule {content['rule']}. The population optimum moved by {100 * content['nrmse']:.1f} % of the search"
        f" ranges (NRMSE), {_ROBUST[content['flagged']]}.",
        warnings=content["warnings"],
        flagged=_flagged_words([p["participant"] for p in content["participants"] if p["flagged"]]),
        figures=pictures,
        head=["", *(_head(study, name) for name in content["fixed"]["parameters"]), "f"],
        optima=[
            [
                label,
                *(_number(v) for v in optimum["parameters"].values()),
                f"{optimum['mean']:.2f} ± {optimum['sd']:.2f}",
            ]
            for label, optimum in (("fixed", content["fixed"]), ("by evidence", content["optimised"]))
        ],
        learned="; ".join(f"{name} {_numbers(learned[name])}" for name in ("theta", "noise", "thresholds"))
        if learned["shared"]
        else "",
        sensitivity_head=["", *(_head(study, name) for name in study.space.names)],
        sensitivity=[[name, *values] for name, values in _sensitivity_rows(content["sensitivity"])],
        people=[[p["participant"], f"{100 * p['nrmse']:.1f} %", _remark(p)] for p in content["participants"]],
        versions=", ".join(f"{k} {v}" for k, v in versions.items()),
    )


_ROBUST = {True: "which is 3 % or more: it is not robust", False: "less than 3 %: it is robust"}


def _flagged_words(names):
    if not names:
        return "No individual optimum moved by 3 % or more."
    return f"Individual optima that moved by 3 % or more: {', '.join(names)}."


def _remark(person):
    remarks = {"flagged": person["flagged"], "no maximum in reach": person["runaway"]}
    remarks["search not converged"] = not person["converged"]
    return ", ".join(words for words, holds in remarks.items() if holds)


_COORDINATES = {"theta": "ln theta", "noise": "ln noise", "first": "lowest threshold", "gaps": "ln gap"}


def _sensitivity_rows(blocks):
    """A row for each hyperparameter, in percent of the search ranges for a change by 0.1."""
    for name, block in blocks.items():
        columns = np.atleast_2d(np.asarray(block).T)
        for i, column in enumerate(columns):
            label = _COORDINATES[name] + (f" {i + 1}" if len(columns) > 1 else "")
            yield label, [f"{10 * value:+.2f} %" for value in column]


def _numbers(values):
    return ", ".join(_number(v) for v in np.ravel(values))


def template(name: str):
    """A page of hilbo.templates, escaping what it is given."""
    from jinja2 import Environment, PackageLoader, select_autoescape

    return Environment(loader=PackageLoader("hilbo.report"), autoescape=select_autoescape()).get_template(name)
