"""Results folders: numbers against the mechanics' golden ones, formats, pages that explain themselves."""

import ast
import dataclasses
import json
from concurrent.futures import Future
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr
from studies import answered, plain_study

from hilbo.kernels import Matern32
from hilbo.report import participants, results
from hilbo.report.page import results_page
from hilbo.report.result_file import as_json
from hilbo.search.box import Constraint
from hilbo.search.rendering import K0_range, Rendering
from hilbo.study.analysis.cohort_results import CohortResults, analyse_cohort
from hilbo.study.analysis.region import Region, region_sentences
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import aggregate_cohort
from hilbo.study.estimate.optimum import predict_people

PAPER = Study.load("hilbo/data/paper.toml")
SYSTEM_IDENTIFICATION = (5.70, 5.89, 0.203)
AGGREGATE = (5.58, 7.88, 0.176)
MEAN_OF_OPTIMA = (8.44, 10.28, 0.282)


def unit(values):
    return np.asarray(PAPER.space.to_unit(np.array(values)))


def test_k0_is_measured_from_the_corner_of_the_box():
    assert K0_range(PAPER.space) == pytest.approx(16.14, abs=0.005)


@pytest.mark.parametrize(("values", "three", "with_K0"), [(AGGREGATE, 0.0393, 0.0352), (MEAN_OF_OPTIMA, 0.105, 0.112)])
def test_misses_are_those_of_the_paper(values, three, with_K0):
    errors = results.misses(PAPER, unit(values), unit(SYSTEM_IDENTIFICATION))
    assert errors == pytest.approx((three, with_K0), abs=5e-4)


def test_errors_by_search_range_are_those_of_the_paper():
    for values, percent in ((AGGREGATE, (1.8, 0.4, 6.2, 2.8)), (MEAN_OF_OPTIMA, (13.1, 8.8, 13.7, 8.1))):
        off = unit(values) - unit(SYSTEM_IDENTIFICATION)
        K0 = [Rendering.at(PAPER.space, unit(v)).shown["K0"] for v in (values, SYSTEM_IDENTIFICATION)]
        percents = 100 * np.abs([(K0[0] - K0[1]) / K0_range(PAPER.space), *off])
        np.testing.assert_allclose(percents, percent, atol=0.06)


def test_misses_of_many_points_are_those_of_each():
    points = np.stack([unit(AGGREGATE), unit(MEAN_OF_OPTIMA)])
    many = np.stack(results.misses(PAPER, points, unit(SYSTEM_IDENTIFICATION)), axis=1)
    each = [results.misses(PAPER, x, unit(SYSTEM_IDENTIFICATION)) for x in points]
    np.testing.assert_allclose(many, each, rtol=1e-12)


def test_a_parameter_set_has_its_k0_and_margin():
    assert Rendering.at(PAPER.space, unit(AGGREGATE)).shown["K0"] == pytest.approx(-3.19, abs=0.01)
    assert Rendering.at(PAPER.space, unit(AGGREGATE)).margin == pytest.approx(0.95 - 0.75981, abs=1e-5)
    assert Rendering.at(PAPER.space, unit(MEAN_OF_OPTIMA)).margin == pytest.approx(0.95 - 1.34159, abs=1e-5)


def test_what_is_not_finite_is_null():
    text = as_json({"a": [float("nan"), 1.0], "b": {"c": float("-inf"), "d": "NaN"}, "e": True})
    assert json.loads(text) == {"a": [None, 1.0], "b": {"c": None, "d": "NaN"}, "e": True}


@pytest.fixture(
    scope="module", params=[pytest.param(1, marks=pytest.mark.deep), 2, pytest.param(4, marks=pytest.mark.deep)]
)
def written(request, tmp_path_factory):
    """Study, aggregate, content and folder of a small study in one, two and four dimensions."""
    study = plain_study(request.param)
    population = analyse_cohort(study, answered(study))
    folder = tmp_path_factory.mktemp(f"d{request.param}")
    truth = np.full(request.param, 0.5) if request.param == 2 else None
    content = results.write_results(population, folder, truth=truth)
    return study, population.aggregate, content, folder


def test_the_content_is_what_stands_in_the_file(written):
    study, aggregate, content, folder = written
    stored = json.loads((folder / "result.json").read_text())
    assert len(stored.pop("digest")) == 16 and stored == content
    assert content["optimum"]["unit"] == aggregate.optimum.x.tolist()
    assert set(content["optimum"]["parameters"]) == set(study.space.names)
    assert sum(content["optimum"]["class_probabilities"].values()) == pytest.approx(1, abs=1e-12)
    assert [p["trials"] for p in content["participants"]] == [6, 6]
    assert (content["study"], content["warnings"]) == (study.file.hash, [])
    assert {"hilbo", "jax", "jaxlib", "numpy", "python", "device", "dtype"} <= set(content["versions"])


def test_the_map_is_the_population_s(written):
    study, aggregate, _, folder = written
    data = xr.load_dataset(folder / "map.nc", engine="h5netcdf")
    names, dims = list(study.space.names), list(data["mean"].dims)
    assert dims == (["point"] if study.space.dim > 3 else names)
    first = data.isel(dict.fromkeys(dims, 0))
    at = study.space.to_unit(np.array([float(first[name]) for name in names]))
    mean, variance = predict_people(aggregate.posteriors, at[None])
    assert float(first["mean"]) == pytest.approx(float(mean[0]), abs=1e-12)
    assert float(first["variance"]) == pytest.approx(float(variance[0]), abs=1e-12)
    assert all(data[name].attrs["units"] == "mm" for name in names)
    assert data.attrs["study"] == study.file.hash
    for name in names if study.space.dim <= 3 else ():
        assert data[name].values[[0, -1]].tolist() == [1.0, 10.0]


class Page(HTMLParser):
    """The tags of a page, which must be closed in order."""

    def __init__(self, text):
        super().__init__()
        self.open, self.images, self.heads, self.captions = [], [], 0, 0
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attrs):
        self.images += [dict(attrs)] if tag == "img" else []
        self.heads += tag == "th" and "scope" in dict(attrs)
        self.captions += tag == "caption"
        if tag not in ("img", "meta", "br", "link"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_page_is_whole_and_needs_nothing_else(written):
    study, _, content, folder = written
    text = (folder / "report.html").read_text(encoding="utf-8")
    page = Page(text)
    assert "<any & all>" not in text and "&lt;any &amp; all&gt;" in text
    assert len(page.images) == {1: 4, 2: 5, 4: 6}[study.space.dim]
    assert all(image["alt"] and image["src"].startswith("data:image/png;base64,") for image in page.images)
    assert page.captions == 3 and page.heads > 10
    assert "://" not in text and "<script" not in text and "nan" not in text.lower().replace("base64", "")[:2000]
    assert ("truth" in text) == ("truth" in content)
    assert study.file.hash in text and content["versions"]["jax"] in text


@pytest.mark.parametrize(
    ("rule", "definition"),
    [
        ("bcm", "the optimum is the maximum of the population map."),
        ("learnt-1", 'The optimum is the point with the largest probability that a new participant answers "good".'),
        (
            "learnt-2",
            "The optimum is the point that is most often near the optimum of joint posterior draws, among points",
        ),
    ],
)
def test_the_page_says_what_the_optimum_is_by_its_rule(written, rule, definition):
    study, aggregate, content, _ = written
    content = content | {"rule": rule, "learnt": {"share": 0.5} if rule.startswith("learnt") else None}
    people = participants.people_of(study, aggregate)
    page = results_page(dataclasses.replace(study, rule=rule), content, {}, people)
    assert definition in " ".join(unescape(page).split())


def test_the_page_prints_the_covariance_of_its_rule(written):
    study, aggregate, content, _ = written
    study = eqx.tree_at(lambda s: s.gp.kernel, study, Matern32(np.full(study.space.dim, 5.5), 2.0))
    page = " ".join(results_page(study, content, {}, participants.people_of(study, aggregate)).split())
    assert "Gaussian-process prior of Matérn 3/2 covariance, k(x, x′) = 2 · (1 + s) exp(−s), s² = 6 Σ θᵢ" in page


def test_the_page_says_where_the_optimum_was_searched(written):
    study, aggregate, content, _ = written
    people = participants.people_of(study, aggregate)
    constraint = Constraint(tuple((name, 1.0) for name in study.space.names), None, 50.0)
    between = dataclasses.replace(study, space=dataclasses.replace(study.space, constraints=(constraint,)))
    page = " ".join(results_page(between, content, {}, people).split())
    assert "searched over the whole box" in results_page(study, content, {}, people)
    assert "whole box" not in page and "within the study's constraints (p0" in page.replace("&#39;", "'")


def test_figures_are_png_and_svg(written):
    study, _, _, folder = written
    for name in ("map", "progress", "slices", *(["optima"] if study.space.dim > 1 else [])):
        assert (folder / f"{name}.png").read_bytes().startswith(b"\x89PNG")
        assert "</svg>" in (folder / f"{name}.svg").read_text()


def test_a_failed_certificate_is_said_in_one_sentence():
    study = plain_study(2)
    aggregate = aggregate_cohort(study, answered(study))
    failed = eqx.tree_at(lambda a: a.posteriors.certificate.converged, aggregate, jnp.array([True, False]))
    content = results.result(study, failed, 0)
    assert content["warnings"] == [
        "The fit of P1 did not reach its tolerance, so that the results may be off by more than rounding;"
        " see the certificate of each fit in result.json."
    ]
    from hilbo.report.page import results_page
    from hilbo.report.participants import people_of

    page = results_page(study, content, {}, people_of(study, failed))
    assert content["warnings"][0] in page and "committee" in page
    other = results_page(study, content | {"rule": "hierarchical"}, {}, people_of(study, failed))
    assert "committee" not in other and "by the method <code>hierarchical</code>" in other


def test_many_participants_are_written_as_few():
    names, x = [f"P{i}" for i in range(5)], np.random.default_rng(0).uniform(size=(5, 3)) * [1, 1, 0.1]
    sets, margins = participants.parameter_sets(PAPER, x)
    for j in range(5):
        one = Rendering.at(PAPER.space, x[j]).shown
        assert {name: values[j] for name, values in sets.items()} == pytest.approx(one, rel=1e-12)
        assert list(sets) == list(one)
        assert margins[j] == pytest.approx(Rendering.at(PAPER.space, x[j]).margin, rel=1e-12)
    optima = {"x": x, "mean": x[:, 0], "sd": x[:, 1], "class_probabilities": x}
    certificate = {"residual": np.array([1.0, np.nan, 0, 0, 0]), "converged": np.ones(5, bool)}
    people = participants.People(names, np.arange(5), certificate, PAPER.responses, optima, sets, margins)
    content = {"rule": "bcm", "participants": people, "alternatives": {"a": {}}}
    text = as_json(content)
    listed = as_json(content | {"participants": list(people.entries())})
    assert json.loads(text) == json.loads(listed)
    assert json.loads(text)["participants"][1]["certificate"] == {"residual": None, "converged": True}
    without = participants.People(names, np.arange(5), certificate, PAPER.responses, None, None, None)
    assert next(without.entries())["optimum"] is None and without.table().empty


def test_a_way_is_said_in_units_and_percent():
    difference = results.moved(PAPER, jnp.asarray(unit(AGGREGATE)), jnp.asarray(unit(SYSTEM_IDENTIFICATION)))
    assert list(difference["moved"]) == ["K0", "K1", "B1", "alpha"]
    assert difference["moved"]["B1"]["by"] == pytest.approx(7.88 - 5.89)
    percents = [way["percent"] for way in difference["moved"].values()]
    np.testing.assert_allclose(np.abs(percents), (1.8, 0.4, 6.2, 2.8), atol=0.06)
    assert difference["nrmse"] == pytest.approx(0.0393, abs=5e-4)


def test_pages_compute_nothing_of_an_analysis_and_one_module_writes_result_json():
    """A cohort's region, model check and comparison of rules are parts of its analysis."""
    computed = {"optimum_region", "model_check", "compare", "follow", "analyse_cohort", "aggregate_cohort"}
    writers, imported = set(), set()
    for path in Path(results.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and node.value == "result.json":
                writers.add(path.name)
            if isinstance(node, ast.ImportFrom):
                imported |= {alias.name for alias in node.names}
    assert writers == {"result_file.py"} and not imported & computed and "CohortResults" in imported


def test_the_region_and_the_model_check_are_those_of_the_analysis(written):
    study, aggregate, content, _ = written
    assert content["optimum_region"] is None and content["model_check"] is None  # of bcm, and of two people
    region = Region(np.full((1, study.space.dim), 0.5), np.zeros((1, study.space.dim)), 0.75)
    population = CohortResults(study, aggregate, Future(), 0, region, None)
    said = results.cohort_content(population, None, participants.people_of(study, aggregate))
    assert said["optimum_region"]["volume"] == 0.75
    assert said["warnings"] == [*content["warnings"], *region_sentences(region)]
