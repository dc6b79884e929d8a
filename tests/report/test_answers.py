"""Marks of answers on maps: nothing that was answered is hidden by what else was answered at the same place."""

from io import BytesIO

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from studies import population_study

from hilbo.report.figures.answers import answer_handles, mark_along, mark_trials
from hilbo.report.figures.maps import map_handles
from hilbo.report.figures.style import ONE_COLUMN, legend, new_figure, plain, styled
from hilbo.study.cohort import cohort_of
from hilbo.study.config import Study

STUDY = population_study()  # answers bad, fair, good; gain and delay
ANSWERS = {(2.0, 1.0): [0, 1, *[2] * 10], (4.0, 2.0): [1, 1], (8.0, 4.0): [0]}


def cohort(answers, study=STUDY):
    rows = [(*place, study.responses[k]) for place, categories in answers.items() for k in categories]
    table = pd.DataFrame(rows, columns=[*study.space.names, "response"])
    return cohort_of(table.assign(participant=[f"P{i}" for i in range(len(rows))], trial=1), study)


def areas(axes):
    """Place -> area in points² of each colour that is drawn there."""
    drawn = {}
    for marks in axes.collections:
        x, y = np.array(marks.get_paths()[0].to_polygons()[0]).T
        area = 0.5 * abs(x[:-1] @ y[1:] - x[1:] @ y[:-1]) * marks.get_sizes()[0]
        for place in np.asarray(marks.get_offsets()):
            colours = drawn.setdefault(tuple(np.round(place, 9)), {})
            colours[tuple(np.round(marks.get_facecolor()[0], 6))] = area
    return drawn


def test_the_disc_of_a_place_has_the_shares_of_its_answers():
    axes = Figure().subplots()
    counts = mark_trials(axes, STUDY, cohort(ANSWERS), None)
    assert sorted(counts) == [1, 2, 12]
    drawn = areas(axes)
    wedges = np.array(list(drawn[2.0, 1.0].values()))
    np.testing.assert_allclose(wedges / wedges.sum(), np.array([1, 1, 10]) / 12, atol=0.01)
    assert len(drawn[4.0, 2.0]) == len(drawn[8.0, 4.0]) == 1
    assert wedges.sum() > drawn[4.0, 2.0].popitem()[1] > drawn[8.0, 4.0].popitem()[1]


def test_a_legend_names_every_answer_and_how_many_a_disc_holds():
    def labels(counts, **options):
        return [handle.get_label() for handle in answer_handles(STUDY, np.array(counts), **options)]

    assert labels([1, 1]) == ["bad", "fair", "good"]
    assert labels([1, 2, 4])[3:] == ["proportions of 2\nto 4 responses"]
    assert labels([17, 17])[3:] == ["proportions of 17\nresponses"]
    assert labels([1, 3], discs=False)[3:] == ["mark of 3\nresponses"]


def test_answers_at_places_of_their_own_have_their_own_marks():
    axes = Figure().subplots()
    counts = mark_trials(axes, STUDY, cohort({(2.0, 1.0): [0], (4.0, 2.0): [2]}), None)
    assert list(counts) == [1, 1] and len(axes.collections) == 3  # one a category
    shapes = {handle.get_marker() for handle in answer_handles(STUDY, counts)}
    assert len(shapes) == 3


def test_beside_a_map_of_one_parameter_a_mark_grows_with_its_answers():
    study = Study.from_dict(
        {
            "schema": 1,
            "study": {"name": "one", "responses": ["bad", "good"]},
            "parameters": {"gain": {"low": 1.0, "high": 9.0}},
            "gp": {"theta": 5.0, "variance": 1.0, "thresholds": [0.0], "noise": 0.5},
            "selection": {"trials": 6},
        }
    )
    axes = Figure().subplots()
    counts = mark_along(axes, study, cohort({(2.0,): [0, 0, 0, 1], (4.0,): [0, 0]}, study))
    assert sorted(counts) == [1, 2, 3]
    bad, good = (dict(zip(m.get_offsets()[:, 0], m.get_sizes(), strict=True)) for m in axes.collections)
    assert bad[2.0] > bad[4.0] > good[2.0]


def test_a_legend_has_contours_only_where_a_map_has_them():
    assert [line.get_label() for line in map_handles(STUDY)] == ["mean", "standard deviation"]
    levels = {"gain": {"low": 1.0, "high": 9.0}, "texture": {"levels": ["silk", "wood"]}}
    study = Study.from_dict(
        {
            "schema": 1,
            "study": {"name": "levels", "responses": ["bad", "good"]},
            "parameters": levels,
            "gp": {"theta": 5.0, "variance": 1.0, "thresholds": [0.0], "noise": 0.5},
            "selection": {"trials": 6},
        }
    )
    assert map_handles(study) == []


@pytest.mark.parametrize(
    "words", [("a", "b", "c"), ("too soft to be true", "as the real one, or nearly", "$5 too hard")]
)
def test_no_legend_is_wider_than_its_figure(words):
    figure, axes = new_figure(ONE_COLUMN, 2.0)
    handles = [axes.plot([0], [0], "o", label=plain(word))[0] for word in (*words, "mean", "standard\ndeviation")]
    styled(legend)(figure, handles)
    figure.savefig(BytesIO(), format="png")
    assert figure.legends[0].get_window_extent().width <= figure.bbox.width
