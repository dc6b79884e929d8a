"""The pages of docs/: each is in the site's navigation, and what they link to is there. `make docs` builds the site."""

import html
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import msgspec
import pytest

import hilbo
from hilbo.study.file import schema
from hilbo.study.file.columns import UNWRITTEN
from hilbo.study.file.protocols import PhaseTable
from hilbo.study.file.reading import checked
from hilbo.study.file.trial_flags import FLAGS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))
LINKING = [*PAGES, *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "firmware/PROTOCOL.md"))]
FENCED = re.compile(r"^```.*?^```", re.M | re.S)
LINK = re.compile(r"\[[^\]\n]+\]\(([^)\s]+)\)")
each_file = pytest.mark.parametrize("file", LINKING, ids=lambda file: str(file.relative_to(ROOT)))


def script(name):
    """A module of docs/site."""
    spec = importlib.util.spec_from_file_location(name, DOCS / "site" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def text_of(file: Path) -> str:
    """A page without its code."""
    return re.sub(
        r"`[^`\n]*`", lambda code: code[0].replace("[", " "), FENCED.sub("", file.read_text(encoding="utf-8"))
    )


def anchors(file: Path) -> set[str]:
    """The anchors of a page's headings, as code hosts and the site make them."""
    titles = re.findall(r"^#+ (.*)$", text_of(file), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


def broken(file: Path) -> list[str]:
    """The relative links of a page that lead to no file, or to no heading of it."""
    links = []
    for link in LINK.findall(text_of(file)):
        if re.match(r"\w+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (file.parent / path).resolve() if path else file
        if not target.is_file() or (anchor and anchor not in anchors(target)):
            links.append(link)
    return links


def test_navigation_has_every_page_once_and_no_other():
    listed = re.findall(r"^ +- .*: ([\w/-]+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.M)
    written = [page.relative_to(DOCS).as_posix() for page in PAGES]
    assert sorted(listed) == sorted([*written, *script("hooks").generated()])


@each_file
def test_links_lead_to_files_and_headings(file):
    assert broken(file) == []


def test_a_broken_link_is_found(tmp_path):
    (tmp_path / "other.md").write_text("# A title: with marks\n")
    page = tmp_path / "page.md"
    page.write_text("[a](other.md#a-title-with-marks) [b](missing.md) [c](other.md#no) `[d](e)`\n```\n[f](g)\n```\n")
    assert broken(page) == ["missing.md", "other.md#no"]


@each_file
def test_lists_and_tables_stand_apart(file):
    """MkDocs takes a list or a table for text where the line before is a paragraph."""
    lines = text_of(file).split("\n")
    mark = re.compile(r"(?:[-*] |\d+\. |\|)")
    ended = re.compile(r"(?:[-*|#> ]|\d+\. |<!--|$)")
    unfinished = [line for before, line in pairwise(lines) if mark.match(line) and not ended.match(before)]
    assert unfinished == []


def test_modules_of_the_reference_and_names_of_pages_in_the_code_are_there():
    modules = " ".join(names for _, names in script("hooks").API.values()).split()
    assert [name for name in modules if not (ROOT / "hilbo" / f"{name.replace('.', '/')}.py").is_file()] == []
    missing = []
    for folder in ("hilbo", "benchmarks", "firmware", "clients", "notebooks", "attacks", "tests"):
        for file in (f for kind in ("py", "html", "toml", "h", "c") for f in (ROOT / folder).rglob(f"*.{kind}")):
            for name in re.findall(r"\bdocs/[\w/-]+\.(?:md|svg)", file.read_text(encoding="utf-8")):
                missing += [] if (ROOT / name).is_file() else [f"{file.relative_to(ROOT)}: {name}"]
    assert missing == []


def test_the_reference_begins_with_the_public_objects_and_repeats_none():
    made = script("api_pages")
    page = made.objects()
    for name in hilbo.__all__:
        assert f"[`{name}`][{getattr(hilbo, name).__module__}.{name}]" in page
    shown = re.findall(r"members: \[(.*)\]", "".join(made.reference(*entry) for entry in made.API.values()))
    names = [name for members in shown for name in members.split(", ")]
    classes = [name for name in hilbo.__all__ if name[0].isupper()]
    assert [names.count(name) for name in classes] == [1] * len(classes)


def test_tables_of_benchmarks_have_their_marks():
    calls = re.compile(r'\bput\("([\w/.-]+)", "([\w ]+)"')
    asked = [call for file in (ROOT / "benchmarks").glob("*.py") for call in calls.findall(file.read_text("utf-8"))]
    assert len(asked) > 15
    for page, name in asked:
        text = (DOCS / page).read_text(encoding="utf-8")
        assert text.count(f"<!-- {name} -->\n") == text.count(f"<!-- end of {name} -->") == 1, (page, name)


def test_the_choice_of_a_method_is_read_in_five_minutes():
    """The recommendation first, two figures, and the tables on other pages."""
    text = (DOCS / "methods" / "which_method.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 1200
    assert text.index("| your study | method |") < text.index("## Evidence") < text.index("## Limits")
    figures = re.findall(r"^!\[.{100,}\]\((which_method-\w+\.svg)\)$", text, re.M)
    assert len(figures) == 2 and all((DOCS / "methods" / figure).is_file() for figure in figures)


def test_the_page_on_citing_has_the_version_of_the_package():
    version = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    page = (DOCS / "guides" / "citing.md").read_text(encoding="utf-8")
    assert set(re.findall(r"\b\d+\.\d+\.\d+\b", page)) == {version}
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


def test_a_notebook_becomes_text_and_code(tmp_path, monkeypatch):
    made = script("hooks")
    path = made.ROOT / "notebooks" / "quick_start.py"
    monkeypatch.setattr(made, "EXECUTED", tmp_path)
    page = made.notebook(path)
    assert page.startswith("# Quick start\n")
    assert page.count("```python\n") == page.count("\n```\n") == path.read_text("utf-8").count("# %%\n")
    book = [{"cell_type": kind, "source": text} for kind, text in made.cells(path)]
    book[1]["outputs"] = [{"name": "stdout", "text": ["one\n", "two\n"]}, {"data": {"image/png": "abc"}}]
    (tmp_path / "quick_start.ipynb").write_text(json.dumps({"cells": book}))
    shown = made.notebook(path)
    assert "```text\none\ntwo\n```" in shown and "base64,abc" in shown and 'href="quick_start.ipynb"' in shown
    book[1]["source"] += "\nmore()"  # not this script's any more
    (tmp_path / "quick_start.ipynb").write_text(json.dumps({"cells": book}))
    assert made.outputs(path) is None and made.notebook(path) == page


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_the_site_runs_changed_notebooks_unless_told_not_to():
    shown = [
        subprocess.run(["make", "-n", "docs", *given], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        for given in ([], ["NOTEBOOKS=no"])
    ]
    assert ["docs/site/notebooks.py --changed" in text for text in shown] == [True, False]
    assert all("mkdocs build --strict" in text for text in shown)


def test_links_between_files_become_links_between_pages():
    link = script("hooks").site_link
    assert link("docs/guides/live.md", "../device/device.md#x") == "../device/device.md#x"
    assert link("docs/design.md", "../firmware/PROTOCOL.md") == "device/protocol.md"
    assert link("firmware/PROTOCOL.md", "../docs/device/firmware.md") == "firmware.md"
    assert link("docs/index.md", "../notebooks/device.py") == "notebooks/device.md"
    assert link("docs/index.md", "../LICENSE") is None


def test_pictures_of_the_readme_are_shown_on_its_page():
    page = SimpleNamespace(file=SimpleNamespace(src_uri="readme.md"))
    shown = script("hooks").on_page_markdown("![map](docs/population-map.png) [licence](LICENSE)", page, None, None)
    assert shown == "![map](population-map.png) licence"


def schemas():
    """The tables of a study file by the heading of the page that describes them."""
    tables = {f"[{name}]": kind for name, kind in schema.TABLES.items()}
    own = {"[renderer]": schema.RendererTable, "[parameters.NAME]": schema.ParameterTable}
    own["[parameters.NAME] of levels"] = schema.LevelsTable
    return tables | own | {"[session.PHASE]": PhaseTable}


@pytest.mark.parametrize("table", schemas())
def test_the_study_files_page_has_every_key_and_its_default(table):
    text = (DOCS / "guides" / "study-file.md").read_text(encoding="utf-8")
    section = text.split(f"## {table}\n")[1].split("\n## ")[0]
    rows = dict(re.findall(r"^\| `(\w+)` \| (.*?) \|", section, re.M))
    fields = [f for f in msgspec.structs.fields(schemas()[table]) if f.type not in (PhaseTable,)]
    assert list(rows) == [field.encode_name for field in fields]
    for field in fields:
        if field.required:
            assert rows[field.encode_name] == "needed"
        elif isinstance(field.default, str | int | float | bool):
            assert tomllib.loads(f"value = {rows[field.encode_name].strip('`')}")["value"] == field.default


def test_the_study_files_on_the_page_are_good():
    text = (DOCS / "guides" / "study-file.md").read_text(encoding="utf-8")
    for block in re.findall(r"```toml\n(schema.*?)```", text, re.S):
        assert checked(tomllib.loads(block), "page", lambda file: file.name)


def _commands(text):
    """Commands of a page that its script runs: blocks of one command; sessions with a device are only shown."""
    return [c for c in re.findall(r"^```\n(hilbo .*)\n```", text, re.M) if "--device PORT" not in c]


def _check_page(made, steps):
    """Commands, words and figures of a page are those of the steps of its script; no path of a machine is on it."""
    text = made.PAGE.read_text(encoding="utf-8")
    assert _commands(text) == [step.command for step in steps if step.command]
    for step in steps:
        assert step.words in text
        for name, caption in step.figures:
            figure = name.replace("/", "-")
            assert f"![{caption}]({made.FIGURES.name}/{figure})" in text and (made.FIGURES / figure).is_file()
    assert not re.search(r"/(tmp|root|home|work)/", text)


def test_the_first_study_is_that_of_its_script():
    """The script runs all of the commands, a deep test those that take seconds."""
    made = script("first_study")
    _check_page(made, made.STEPS)


@pytest.mark.deep
def test_the_first_study_begins_as_its_page_says(tmp_path):
    made, text = script("first_study"), (DOCS / "guides" / "first-study.md").read_text(encoding="utf-8")
    quick = [step for step in made.STEPS if step.command.split()[1] in ("init", "plan")]
    assert len(quick) == 2
    for step in quick:
        assert made.section(step, tmp_path, made.FIGURES) in text, "run python docs/site/first_study.py"


def _skeleton(command):
    """A command without its numbers and ids."""
    return re.sub(r"\d+(\.\d+)?", "0", re.sub(r"\b([A-Z])\d\d(,\1\d\d)*", r"\1", command))


def test_the_haptic_study_is_that_of_its_script():
    """The script runs all of the commands, a deep test those of a small study."""
    made = script("haptic_study")
    _check_page(made, made.steps(made.FULL, made.LAB))


@pytest.mark.deep
def test_a_small_haptic_study_runs_by_the_commands_of_its_page(tmp_path):
    """Two people for each material, from the device to the report."""
    made, text = script("haptic_study"), (DOCS / "guides" / "haptic-study.md").read_text(encoding="utf-8")
    small = made.steps(made.SMALL, made.LAB)
    assert [_skeleton(c) for c in _commands(text)] == [_skeleton(step.command) for step in small if step.command]
    made.page(made.SMALL, made.LAB, tmp_path, tmp_path / "figures")
    report = json.loads((tmp_path / "report" / "result.json").read_text(encoding="utf-8"))
    page = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    assert list(report["materials"]) == ["foam", "medium", "stiff"]
    assert page.count("Nothing departs from the plan") == 3
    check_places_of_the_papers_numbers(tmp_path)


def check_places_of_the_papers_numbers(folder):
    """What docs/results/paper.md sets in italics is on the page of a report, in its first section on that of an
    identification; files that it names exist."""
    first, *others = (DOCS / "results" / "paper.md").read_text(encoding="utf-8").split("\n## ")[1:]
    for sections, page in (([first], folder / "foam"), (others, folder / "report")):
        text = re.sub(r"<[^>]*>", " ", (page / "report.html").read_text(encoding="utf-8"))
        text = " ".join(html.unescape(text).split())
        places = [row.split("|")[3] for section in sections for row in section.splitlines() if row.count("|") == 5]
        words = [word for place in places for word in re.findall(r"\*([^*]+)\*", place)]
        files = {name for place in places for name in re.findall(r"`(\w+\.(?:csv|toml))`", place)}
        assert words and [word for word in words if word not in text] == []
        assert files and [name for name in files if not [*page.rglob(name)]] == []


@pytest.mark.deep
def test_the_picture_of_the_readme_is_drawn_from_the_demos_numbers():
    """Compiled as by users: simulated sessions amplify rounding, and other compiler options choose other trials."""
    made = script("readme_picture")
    environment = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    run = [sys.executable, made.__file__, "--computed"]
    computed = json.loads(subprocess.run(run, env=environment, check=True, stdout=subprocess.PIPE).stdout)
    shown = json.loads(made.NUMBERS.read_text(encoding="utf-8"))
    assert list(computed) == list(shown)
    for name, values in shown.items():
        assert computed[name] == pytest.approx(values, rel=0.02), name


def test_the_data_dictionary_is_that_of_the_code():
    page = script("columns").page()
    assert (DOCS / "guides" / "columns.md").read_text(encoding="utf-8") == page, "run python docs/site/columns.py"
    assert ", ".join(FLAGS) in page and f"'{UNWRITTEN}'" in page


def test_the_page_of_mistakes_says_what_hilbo_says():  # fits once, for what is said in Python: 2 s
    page = script("mistakes").page()
    assert (DOCS / "guides" / "mistakes.md").read_text(encoding="utf-8") == page, "run python docs/site/mistakes.py"
    assert page.count("\n| ") >= 3 * 2 + 20
