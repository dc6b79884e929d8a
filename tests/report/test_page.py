"""Pages: a number that a template misses is an error, and what a page says of the same numbers told differently."""

import dataclasses
import re
import tomllib
from html import unescape
from pathlib import Path
from types import MappingProxyType

import numpy as np
import pytest
from jinja2 import UndefinedError
from studies import plain_study

import hilbo
from hilbo import Study
from hilbo.report.page import _environment, rendered
from hilbo.report.robustness import robustness_page
from hilbo.report.study import report as study_report
from hilbo.search.rendering import Rendering
from hilbo.study.folder import StudyFolder

VERSIONS = {"hilbo": "1", "python": "3.11"}


def words(page):
    """What a reader sees of a page, in one line."""
    return " ".join(re.sub(r"<[^>]*>", " ", page.split("</head>")[1]).split())


def test_a_missing_number_is_an_error():
    with pytest.raises(UndefinedError, match="is undefined"):
        rendered("robustness.html", warnings=[])


def test_an_extent_has_both_ends_or_every_level():
    study, ends = plain_study(2), _environment().filters["ends"]  # p1 from 1 to 10
    assert ends([1.25, 3.0], study, "p1") == "1.2 to 3.0"
    assert ends([4.0, 4.0], study, "p1") == "4.00"
    assert ends(["stone"], study, "p1") == "stone"
    assert ends(["silk", "stone", "wood"], study, "p1") == "silk or stone or wood"


def test_a_caption_is_text_in_the_description_of_its_figure():
    figure = {"png": "", "width": "10"}
    content = {"materials": [], "study": "abc", "seed": 0, "versions": VERSIONS}
    section = {"material": "<foam>", "participants": 1, "comparisons": 2, "limits": (), "regressions": {}}
    study = plain_study(1)
    for figures, count in (({"validation": figure}, 1), ({}, 0), ({"validation": figure, "aggregate-best": figure}, 2)):
        page = rendered(
            "validation.html", study=study, content=content, warnings=[], sections=[section | {"figures": figures}]
        )
        assert page.count("<img") == count and "&lt;foam&gt;" in page
    assert "preference rate of the first set of each pair, with the 95 % interval" in words(page)
    (alt,) = re.findall(r'alt="(Aggregate-best[^"]*)"', page)
    assert alt.startswith("Aggregate-best against individual-best. Preference rate of the population&#39;s set over")


def test_the_lead_counts_the_people_of_the_map():
    """Once each, whatever number of materials they answered of, and beside them who was left out."""
    content = {"warnings": [], "limits": [], "study": "abc", "seed": 0, "versions": VERSIONS}
    seen = []
    for gone in ({}, {"E": "trials < 6"}, {"E": "trials < 6", "D": "trials < 6", "F": "trials < 6"}):
        sections = [
            {"participants": ["A", "B", "C", "D"], "left_out": gone},
            {"participants": ["A", "B"], "left_out": {}},
        ]
        folder = StudyFolder(plain_study(1), [], None, ())
        facts = {}
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(study_report, "rendered", lambda name, facts=facts, **given: facts.update(given) or "")
            study_report._page(folder, content, sections, [], True)
        seen.append(words(rendered("study.html", **facts | {"sections": []})))
    assert all("Responses of 4 participants, and the resulting population map of" in page for page in seen)
    assert "excluded" not in seen[0] and "1 more is excluded by the study's rule." in seen[1].replace("&#39;", "'")
    assert "2 more are excluded" in seen[2]  # D is on the map of one material
    assert "Responses of 1 participant," in words(rendered("study.html", **facts | {"sections": [], "people": 1}))


def test_a_warning_says_of_which_material_it_is():
    """Where a study has several."""
    folder = StudyFolder(plain_study(1), [], None, ("No sets table.",))
    gel, foam = {"warnings": ["The optimum lies at an edge."]}, {"warnings": ["A fit failed.", "The map is flat."]}
    several = study_report._content(folder, {"gel": gel, "foam": foam}, [], 0)
    assert several["warnings"] == ["gel: The optimum lies at an edge.", "foam: A fit failed.", "foam: The map is flat."]
    assert several["materials"]["gel"] == gel and several["limits"] == ["No sets table."]
    for name in ("gel", ""):
        assert study_report._content(folder, {name: gel}, [], 0)["warnings"] == gel["warnings"]


def test_it_says_why_rules_were_not_compared():
    macro = _environment().get_template("parts.html").module.not_compared
    assert "needs three participants" in macro(True) and "--no-compare" not in macro(True)
    assert "--no-compare" in macro(False) and "needs" not in macro(False)


def robust(nrmse, resampled=MappingProxyType({"median": 0.02, "95 %": 0.025}), sensitivity=None):
    """The page of a robustness check of two people, the second of whom moved."""
    study = plain_study(2)
    optimum = {"parameters": Rendering.at(study.space, np.full(2, 0.5)).shown, "mean": 1.0, "sd": 0.25}
    optimum |= {
        "class_probabilities": dict(zip(study.responses, (0.25, 0.75), strict=True)),
        "near": {"answers": 7, "highest": 5},
        "location": [],
    }
    learned = {"parameters": ["theta", "noise"], "criterion": "the evidence", "gain": 12.3}
    learned |= {"theta": [5.0, 1 / 3], "variance": 1.0, "noise": 0.5, "thresholds": [0.0]}
    content = {
        "warnings": ["a < b"],
        "fixed": optimum,
        "optimised": optimum,
        "local": optimum,
        "fixed_again": optimum | {"location": ["at the lowest u"]},
        "nrmse": nrmse,
        "local_nrmse": 0.011,
        "flagged": nrmse >= 0.03,
        "resampled": resampled,
        "resampled_moves": resampled,
        "rule": "bcm",
        "aggregated": "",
        "participants": [
            {"participant": "A", "nrmse": 0.01, "flagged": False},
            {"participant": "B", "nrmse": 0.2, "flagged": True},
        ],
        "pilot": None,
        "learned": learned,
        "inference": "laplace",
        "sensitivity": sensitivity,
        "versions": VERSIONS,
    }
    return words(robustness_page(study, content, {}))


def test_the_page_of_a_robustness_check():
    page = robust(0.01, sensitivity={"theta": [0.1, -0.2], "gaps": [[0.1, 0.2], [0.3, 0.4]]})
    assert "optimised: theta, noise; 12.3 nats more" in page and "that maximise the evidence, with weak priors" in page
    assert "1.0 % of the search ranges (NRMSE), less than the paper's bound of 3 %." in page
    table = "[gp] theta = [5.0, 0.3333] variance = 1.0 thresholds = [0.0] noise = 0.5"
    assert table in page and "a &lt; b" in page
    assert "moved by 3 % or more: B." in page and "B 20.0 % flagged" in page
    assert "1.1 % 1.00 ± 0.25 75 % 7 (5)" in page and "at the lowest u" in page
    assert "ln theta +1.00 % -2.00 %" in page and "ln gap 2 +2.00 % +4.00 %" in page
    assert (
        "sampling error of the optimum itself is 2.0 % (median" in page
        and "the shift is no larger than the sampling error" in page
    )
    moved = robust(0.03)
    assert "at least the paper's bound of 3 %" in moved and "the shift is larger than the sampling error" in moved
    assert "Sensitivity" not in moved


def test_one_person_claims_no_sampling_error():
    page = robust(0.01, resampled=None)
    assert "With one participant the sampling error is not known." in page and "bootstrap" not in page


def test_peaks_are_named_by_their_tops_and_a_single_one_is_not_named():
    """The mean of the draws on a peak may be a dark part of the map; its top is not."""
    peaks = _environment().get_template("parts.html").module.peaks
    study = plain_study(2)
    high = {"probability": 0.7, "top": {"p1": 7.543}, "centre": {"p1": 5.2}}
    low = {"probability": 0.3, "top": {"p1": 2.0}, "centre": {"p1": 3.0}}
    assert str(peaks(study, [high])) == ""
    page = " ".join(str(peaks(study, [high, low])).split())
    assert "p1 = 7.54 (70 %); p1 = 2.00 (30 %)." in page and "5.2" not in page


def test_a_sentence_in_a_table_wraps_and_a_number_does_not():
    """A sentence on one line would end beyond the right edge of the page."""
    row = (
        _environment().get_template("parts.html").module.row(["hierarchical", "4.07", "an extrapolation: " + "x " * 20])
    )
    assert row.count("<td") == 2 and row.count('<td class="n">') == 1 and '<td class="n">4.07' in row


def test_no_two_macros_have_one_name():
    """The second would stand in for the first, with other arguments."""
    source = (Path(hilbo.__file__).parent / "report" / "templates" / "parts.html").read_text(encoding="utf-8")
    names = re.findall(r"{% macro (\w+)\(", source)
    assert len(names) > 10 and len(names) == len(set(names))


@pytest.mark.parametrize("region", [None, {"u": [0.2, 0.4], "bit rate": [1.0, 1.0], "größe.x": ["from wood", "tin"]}])
def test_the_card_of_a_page_has_the_answer(region):
    """In any words: levels and names of parameters stay as they are, and the TOML can be read."""
    raw = {"schema": 1, "study": {"name": "s", "responses": ["bad", "good"]}, "aggregation": {"rule": "learnt-2"}}
    levels = {"levels": ["from wood", "tin"]}
    scale = {"low": 0.0, "high": 2.0, "unit": "kbit/s"}
    study = Study.from_dict(raw | {"parameters": {"u": scale, "bit rate": scale, "größe.x": levels}})
    best = {"u": 0.3, "bit rate": 1.0, "größe.x": "from wood"}
    numbers = [
        {"key": "population_error", "result": "Population error", "value": float("nan")},
        {"key": "individual_error", "result": "Individual error", "value": 12.5},
    ]
    content = {"optimum": {"parameters": best, "class_probabilities": {"bad": 0.2, "good": 0.8}}, "rule": "learnt-2"}
    content |= {"highest_answer": {"low": 0.6, "high": 0.9}, "key_numbers": numbers}
    content["warnings"] = ["The optimum is at the lowest u (0 kbit/s): values beyond it were not tested.", "Remark."]
    content["optimum_region"] = region and {"probability": 0.95, "volume": 0.1, "located": True, "parameters": region}
    card = _environment().from_string('{% import "card.html" as answer %}{{ answer.card(study, content, 3, 60, {}) }}')
    text = unescape(card.render(study=dataclasses.replace(study, learnt=object()), content=content))
    assert tomllib.loads(re.search(r"<pre>(.*?)</pre>", text, re.S)[1])["optimum"] == best
    said = " ".join(text.split())
    assert "nan" not in said and "Individual error: 12.5 %" in said and "80 % (95 % interval 60 % to 90 %)" in said
    assert ("from wood or tin" in said and "0.20 to 0.40" in said) == (region is not None)
    assert ("Located: the credible region covers 10 % of the feasible region" in said) == (region is not None)
    assert "u (kbit/s)<sup>1</sup>" in said and "Optimum<sup>2</sup>" in said and "<li>Remark.</li>" in said
    assert ("region was not computed" in said) == (region is None)
