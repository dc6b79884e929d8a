"""Words of a study in figures: what stands between two dollars is a price, and no formula."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cbook import is_math_text
from matplotlib.figure import Figure
from matplotlib.text import Text
from studies import PLAIN

from hilbo.report.figures.answers import answer_handles
from hilbo.report.figures.maps import maps_beside
from hilbo.report.figures.people import predictive_check
from hilbo.report.figures.style import label_axes, level_words
from hilbo.study.config import Study

WORDS = "$5 or $6 §"
STUDY = Study.from_dict(
    PLAIN
    | {
        "study": {"name": WORDS, "responses": ["$1 or $2 §", WORDS], "attribute": f"value of {WORDS}"},
        "parameters": {
            "price$": {"low": 1.0, "high": 9.0, "unit": "$"},
            "share": {"low": 0.0, "high": 1.0, "unit": "%"},
            "fee$": {"low": 1.0, "high": 9.0, "unit": "$ §"},
            "shop": {"levels": [WORDS, "$7 or $8 §"]},
        },
        "gp": {"theta": 30.0, "variance": 1.0, "thresholds": [0.0], "noise": 0.5},
    }
)


def shown(figure):
    """Texts of a figure that was drawn, as a reader sees them."""
    FigureCanvasAgg(figure).draw()
    texts = [text.get_text() for text in figure.findobj(Text)]
    assert not any(is_math_text(text) for text in texts if "§" in text)
    return {text.replace(r"\$", "$") for text in texts}


def test_units_of_a_title_and_names_of_axes_are_no_formula():
    figure = Figure(layout="constrained")
    axes = figure.subplots()
    label_axes(axes, STUDY, 2, 3)
    axes.set_title(", ".join(level_words(STUDY, k, 0.5) for k in (0, 1, 2, 3)))
    texts = shown(figure)
    assert {"fee$ ($ §)", "$7 or $8 §"} <= texts
    assert any(text.startswith("price$ = 5 $, share = 0.5 %, fee$ = 5 $ §, shop = $") for text in texts)


@pytest.mark.parametrize("which", ["maps", "responses", "legend"])
def test_responses_and_what_is_judged_are_no_formula(which):
    if which == "maps":
        two = Study.from_dict(
            PLAIN | {"study": {"name": "a", "responses": ["a", "b", "c"], "attribute": f"value of {WORDS}"}}
        )
        flat = lambda x: (np.zeros(len(x)), np.ones(len(x)))  # noqa: E731
        assert f"mean latent score f (no unit)\nvalue of {WORDS}" in shown(
            maps_beside(two, {"one": flat}, np.array([[0.5, 0.5]]))
        )
    elif which == "responses":
        figure = predictive_check(STUDY.responses, np.array([0.5, 0.5]), np.full((3, 2), 0.5))
        assert set(STUDY.responses) <= shown(figure)
    else:
        figure = Figure()
        figure.legend(handles=answer_handles(STUDY, np.array([1, 1])))
        assert set(STUDY.responses) <= shown(figure)
