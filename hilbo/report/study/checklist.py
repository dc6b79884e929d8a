"""A checklist of Bayesian reporting, filled in from the analysis, with lines left open for the authors.

The items follow those of Kruschke (2021), Bayesian Analysis Reporting Guidelines, Nature Human Behaviour 5:1282-1291,
in our own words.
"""

from typing import Any, NamedTuple

import numpy as np

from hilbo.population.rules.registry import RULES
from hilbo.report.digits import parameter_text
from hilbo.report.kernel_words import covariance_words, formula
from hilbo.report.page import percent
from hilbo.study.analysis.analysis import Analysis

__all__ = ["Item", "checklist"]

_OPEN = "To be written by you: "
_APPROXIMATIONS = {
    "laplace": "a Gaussian at the posterior's mode (Laplace)",
    "ep": "expectation propagation",
    "ep_corrected": "expectation propagation with corrections",
    "exact": "independent draws of the exact posterior",
}


class Item(NamedTuple):
    """One item: the `question`, the answer `known` from the files, and what remains `to_write` by the authors; either
    of the last two may be empty.
    """

    question: str
    known: str
    to_write: str


def checklist(analysis: Analysis, content: dict[str, Any], validated: bool) -> list[Item]:
    """The items of the checklist for one material. `content`: its part of result.json; `validated`: whether there was a
    validation session.
    """
    return [
        Item("Goal", "", f"{_OPEN}the aim of the study, and the reason for a Bayesian analysis."),
        Item("Data", _data(analysis), ""),
        Item("Model and prior", _model(analysis), f"{_OPEN}justification of the hyperparameters."),
        Item("Prior prediction", _prior(analysis), ""),
        Item("Computation", _computation(analysis, content), ""),
        Item("Posterior", _posterior(analysis, content), ""),
        Item("Posterior prediction", _prediction(content, validated), ""),
        Item("Decisions", "No hypothesis is accepted or rejected by a bound on this page.", _decisions()),
        Item("Sensitivity", _sensitivity(content), ""),
        Item(
            "Reproducibility",
            f"study {content['study']}, seed {content['seed']}, hilbo {content['versions']['hilbo']}; dictionary.csv"
            " explains every column, map.nc and inference.nc contain map and posterior.",
            f"{_OPEN}availability of study file, tables and logs.",
        ),
    ]


def _data(analysis):
    """Sentence on the data: participants, responses each, parameters, and number of excluded participants."""
    counts, study = analysis.cohort.counts(), analysis.study
    many = f"{counts.min()}" if counts.min() == counts.max() else f"{counts.min()} to {counts.max()}"
    return (
        f"{len(counts)} participants, {many} answers each ({', '.join(study.responses)}) on {study.file.attribute},"
        f" over {', '.join(study.space.names)}; left out by the rule stated before: {len(analysis.left_out)}."
    )


def _model(analysis):
    """Sentence on the model: likelihood, covariance, hyperparameters and whether they were learnt, aggregation
    method.
    """
    study, gp = analysis.study, analysis.study.gp
    given = "as the study file states" if study.learnt is None else "learnt from these answers by a fixed recipe"
    return (
        f"Ordinal probit likelihood on a latent Gaussian process with a {covariance_words(gp.kernel)} covariance of the"
        f" normalised parameters, {formula(gp.kernel)}; thresholds {_each(gp.likelihood.thresholds)}, noise"
        f" {_each(gp.likelihood.noise)}; all {given}; people aggregated by the rule {study.rule}"
        + (f", with a random effect of {study.file.random_effect}." if analysis.aggregate.map.effects else ".")
    )


def _prior(analysis):
    """Sentence with the response probabilities that the model predicts without data."""
    gp = analysis.study.gp
    chances = np.asarray(gp.likelihood.class_probabilities(np.zeros(()), np.asarray(gp.kernel.variance)))
    shares = ", ".join(f'"{label}" {percent(p)}' for label, p in zip(analysis.study.responses, chances, strict=True))
    return f"Before any answer the model predicts {shares}, everywhere."


def _computation(analysis, content):
    """Sentence with the inference method and the number of fits that converged."""
    certificates = [person["certificate"] for person in content["participants"]]
    good = sum(bool(c["converged"]) for c in certificates)
    return (
        f"Each posterior by {_APPROXIMATIONS[content['inference']]}; {good} of {len(certificates)} fits reached their"
        " tolerance (certificates in result.json)."
    )


def _posterior(analysis, content):
    """Sentence with the optimum, its latent score and standard deviation."""
    best = content["optimum"]
    study = analysis.study
    where = ", ".join(f"{name} {parameter_text(study, name, value)}" for name, value in best["parameters"].items())
    definition = RULES[study.rule].optimum_for(study.goal_label, study.goal.is_highest)
    return (
        f"The optimum is, among the stimuli that may be presented, {definition}: {where}; latent score"
        f" {best['mean']:.2f} ± {best['sd']:.2f} (standard deviation); tolerance intervals with bootstrap resamples of"
        " the people above."
    )


def _prediction(content, validated):
    """Sentence with the cross-validated cost of the map and of constant proportions, and whether there was a
    validation; without a model check, that there are too few participants.
    """
    check = content["model_check"]
    if check is None:
        return "Too few participants to leave one out."
    costs = check["negative_log_density"]
    again = "There were validation sessions." if validated else "There were no validation sessions."
    return (
        f"Leave-one-participant-out: {costs['map']:.3f} nats per response by this map and the participant's earlier"
        f" responses, {costs['constant']['cost']:.3f} by constant proportions. {again}"
    )


def _decisions():
    """The line on decisions, which is left to the authors."""
    return f"{_OPEN}the decisions based on these results, their bounds, and whether they were set in advance."


def _sensitivity(content):
    """Sentence with the shift of the optimum by learnt hyperparameters and, if there was one, by another inference.
    `content`: of a material's part of result.json."""
    parts = [f"hyperparameters of maximum evidence move the optimum by {percent(content['optimised']['nrmse'], 1)}"]
    if "other_inference" in content:
        other = content["other_inference"]
        parts.append(f"inference by {other['inference']} by {percent(other['nrmse'], 1)}")
    return f"Of the search ranges: {'; '.join(parts)}; other methods are among the alternative estimates."


def _each(values: Any) -> str:
    """Numbers of an array as text with four digits, separated by commas."""
    return ", ".join(f"{float(v):.4g}" for v in np.ravel(np.asarray(values)))
