"""Figures of studies with discrete parameters: nothing is evaluated between levels, where no stimulus is, and levels
have no order.
"""

from concurrent.futures import Future
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from studies import PLAIN
from surfaces import SURFACES, TEXTURES, surfaces

from hilbo.ordinal_gp import Trials, fit
from hilbo.report.figures import goal_map, on_axes, regions
from hilbo.report.figures.population import coverage_figure
from hilbo.report.figures.progress import progress_figure
from hilbo.report.figures.study import _sets_on_curve
from hilbo.report.results import misses
from hilbo.study.analysis.cohort_results import CohortResults
from hilbo.study.analysis.progress import Progress
from hilbo.study.analysis.region import Region
from hilbo.study.config import Study

LEVELS = [0.0, 0.5, 1.0]
ONE = Study.from_dict(SURFACES | {"parameters": {"texture": {"levels": list(TEXTURES)}}, "gp": PLAIN["gp"]})


class Asked:
    """A map with a standard deviation of 0.5, and of 1 at the second level of the last coordinate; `x`: all coordinates
    of the points at which it was evaluated.
    """

    def __init__(self, column=-1):
        self.x, self.column = [], column

    def predict(self, points):
        last = np.asarray(points)[:, self.column]
        self.x += last.tolist()
        return last, np.where(last == 0.5, 1.0, 0.25)


def curve_of_a_map(asked, monkeypatch):
    monkeypatch.setattr(on_axes, "_mean_and_variance", lambda model, x: asked.predict(x))
    axes = Figure().subplots()
    on_axes.plot_map(ONE, fit(ONE.gp, Trials.from_arrays(np.array([[0.5]]), np.array([2]))), ax=axes)
    return axes


def curve_of_sets(asked, monkeypatch):
    return _sets_on_curve(ONE, asked.predict, {"best": np.array([0.5])}).axes[0]


def curve_of_coverage(asked, monkeypatch):
    return coverage_figure(ONE, asked.predict, np.array([0.5]), 1.0).axes[0]


@pytest.mark.parametrize("draw", [curve_of_a_map, curve_of_sets, curve_of_coverage])
def test_curves_are_evaluated_at_the_levels_alone(draw, monkeypatch):
    asked = Asked()
    np.testing.assert_array_equal(draw(asked, monkeypatch).lines[0].get_xdata(), [0, 1, 2])
    assert set(asked.x) == set(LEVELS)


def test_class_probabilities_are_evaluated_at_the_levels_alone(monkeypatch):
    asked = Asked()
    monkeypatch.setattr(regions, "_probabilities", lambda reading, x: np.tile(asked.predict(x)[1][:, None] / 3, 3))
    regions._class_curves(Figure().subplots(), SimpleNamespace(study=ONE, tolerances={}), lambda k: "grey")
    assert asked.x == LEVELS


def test_an_unsampled_level_between_sampled_ones_is_hatched_and_no_more():
    (bar,) = curve_of_coverage(Asked(), None).patches
    assert (bar.get_x(), bar.get_width(), bar.get_hatch()) == (0.5, 1.0, "///")


def test_the_hatched_part_of_a_coverage_map_is_that_of_whole_cells():
    asked = Asked(1)
    figure = coverage_figure(surfaces(), asked.predict, np.full(3, 0.5), 1.0)
    FigureCanvasAgg(figure).draw()
    assert set(asked.x) == set(LEVELS)
    shades, hatched = figure.axes[0].collections
    np.testing.assert_array_equal(shades.get_array()[:, 0], [0.5, 1.0, 0.5])
    sides = [path.vertices[:, 1] for path in hatched.get_paths()]
    assert hatched.get_hatch() == "///" and {*np.concatenate(sides)} == {0.5, 1.5}


def test_distances_to_the_truth_are_those_of_the_tables(monkeypatch):
    """Another level is away by the whole range, whichever it is."""
    study, truth = surfaces(), np.array([0.5, 0.0, 0.5])
    optima = np.array([[0.5, 1.0, 0.5], [0.3, 0.5, 0.5], [0.4, 0.0, 0.5]])
    counts, none = np.arange(1, 4), np.zeros((3, 0))
    progress = Progress(counts, optima, optima[:, None], np.array([3]), none, np.ones((3, 1)), {}, (0, 3, 0))
    monkeypatch.setattr("hilbo.report.figures.progress._top_answers", lambda *_: None)
    monkeypatch.setattr(CohortResults, "cohort", None)
    following = Future()
    following.set_result(progress)
    done = CohortResults(study, None, following, 0, None, None)
    left = progress_figure(study, done, truth).axes[0]
    expected = 100 * misses(study, optima, truth)[0]
    for line in left.lines[:2]:  # of individuals, of which there is one, and of the population
        np.testing.assert_allclose(line.get_ydata(), expected)


@pytest.mark.parametrize("study", [ONE, Study.from_dict(PLAIN)])
def test_the_outline_of_the_card_is_the_region(study):
    """Each even point is drawn inside exactly if it is of the region."""
    even = np.unique(np.asarray(study.space.candidates(64, 0)), axis=0)
    rows = np.arange(len(even)) % 3 == 0
    region = Region(even[rows], even[~rows], float(rows.mean()))
    np.testing.assert_array_equal(goal_map.held(region, even, study.gp.kernel), rows)
    assert [region.holds(x, study.gp.kernel) for x in even] == rows.tolist()
