"""The site that `make docs` builds: its search, its formulas, and its pictures. Needs the extra `docs`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from formulas import rendered

ROOT = Path(__file__).parents[1]
pytestmark = pytest.mark.deep


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site; a warning of MkDocs is an error."""
    pytest.importorskip("mkdocs")
    pytest.importorskip("mkdocstrings")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder]
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def entries(site):
    """The sections of the search index: location, title and text."""
    return json.loads((site / "search" / "search_index.json").read_text(encoding="utf-8"))["docs"]


@pytest.mark.parametrize(
    ("word", "page"),
    [
        ("Likert", "guides/likert.html"),
        ("JND", "guides/likert.html"),
        ("staircase", "guides/likert.html"),
        ("questionnaire", "guides/likert.html"),
        ("cite", "guides/citing.html"),
    ],
)
def test_words_of_the_field_lead_to_a_heading(entries, word, page):
    found = [entry["location"] for entry in entries if word.lower() in entry["title"].lower()]
    assert any(location.split("#")[0] == page for location in found)


def test_the_changelog_is_not_searched(entries):
    assert len(entries) > 500
    assert [entry["location"] for entry in entries if entry["location"].startswith("changelog")] == []


def test_formulas_are_mathml_and_no_tex_is_left(site):
    for page, least in (
        ("mechanics", 40),
        ("inference", 15),
        ("statistics", 20),
        ("aggregation", 6),
        ("identification", 3),
    ):
        text = (site / "methods" / f"{page}.html").read_text(encoding="utf-8")
        assert text.count("<math ") >= least and "$$" not in text and 'class="arithmatex"' not in text


def test_a_formula_becomes_mathml_or_is_refused():
    pytest.importorskip("latex2mathml")
    page = r'<p><span class="arithmatex">\(a &lt; \frac{1}{b}\)</span></p><div class="arithmatex">\[\alpha\]</div>'
    made = rendered(page)
    assert made.count("<math ") == 2 and "<mfrac>" in made and 'display="block"' in made and "&lt;" in made
    with pytest.raises(ValueError, match="does not know"):
        rendered(r'<span class="arithmatex">\(\unheardof{x}\)</span>')
