"""What `make docs` adds to the pages of docs/: notebooks, the API reference, and files that live elsewhere.

A page of docs/ links to a file of the project by its path, so that it reads well on a code host too. Here such a link
becomes one to the page that is made of the file, or plain text where the site has none.
"""

import json
import os
import posixpath
import re
from pathlib import Path

from api_pages import API, objects, reference
from formulas import rendered

ROOT = Path(__file__).parents[2]
FENCE = "```"
EXECUTED = ROOT / "build" / "notebooks"  # with outputs, kept between builds; without them pages show the code alone

ELSEWHERE = {
    "README.md": "readme.md",
    "firmware/PROTOCOL.md": "device/protocol.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
UNSEARCHED = "---\nsearch:\n  exclude: true\n---\n\n"  # the changelog has every word
NOTEBOOKS = {f"notebooks/{path.name}": f"notebooks/{path.stem}.md" for path in sorted(ROOT.glob("notebooks/*.py"))}
PLACES = ELSEWHERE | NOTEBOOKS  # file of the project -> page of the site


def generated() -> dict[str, str]:
    """Page of the site -> its Markdown, of all pages that docs/ does not hold."""
    text = {page: (ROOT / file).read_text(encoding="utf-8") for file, page in ELSEWHERE.items()}
    text["changelog.md"] = UNSEARCHED + text["changelog.md"]
    text |= {page: notebook(ROOT / file) for file, page in NOTEBOOKS.items()}
    text["api/objects.md"] = objects()
    return text | {f"api/{name}.md": reference(*entry) for name, entry in API.items()}


def cells(path: Path) -> list[tuple[str, str]]:
    """Kind (markdown or code) and text of the cells of a percent script."""
    parts = (part.partition("\n") for part in re.split(r"(?m)^# %%", path.read_text(encoding="utf-8"))[1:])
    return [
        ("markdown", re.sub(r"(?m)^# ?", "", body).strip()) if kind.strip() == "[markdown]" else ("code", body.strip())
        for kind, _, body in parts
    ]


def outputs(path: Path) -> list[dict] | None:
    """The cells of a script with their outputs in `EXECUTED`; None if it was not run, or has changed since."""
    executed = EXECUTED / f"{path.stem}.ipynb"
    made = json.loads(executed.read_text(encoding="utf-8"))["cells"] if executed.exists() else []
    return made if [(cell["cell_type"], "".join(cell["source"])) for cell in made] == cells(path) else None


def notebook(path: Path) -> str:
    """A percent script as Markdown: its text, and its code in fences, each followed by its outputs if it was run."""
    parts, made = [], outputs(path)
    for number, (kind, body) in enumerate(cells(path)):
        parts.append(body if kind == "markdown" else f"{FENCE}python\n{body}\n{FENCE}")
        parts += [_output(output) for output in made[number].get("outputs", [])] if made else []
    parts.append(f"Run it with `python {path.relative_to(ROOT)}`; editors show its cells.")
    if made:
        parts[-1] += f' Or open <a href="{path.stem}.ipynb" download>the notebook</a>.'
    return "\n\n".join(part for part in parts if part) + "\n"


def _output(output: dict) -> str:
    """What a cell printed or drew."""
    data = output.get("data", {})
    if "image/png" in data:
        return f'<img alt="Figure of the cell above" src="data:image/png;base64,{"".join(data["image/png"]).strip()}">'
    text = "".join(output.get("text", data.get("text/plain", "")))  # Jupyter writes lines as lists
    return f"{FENCE}text\n{text.rstrip()}\n{FENCE}" if output.get("name") != "stderr" and text.strip() else ""


def site_link(file: str, target: str) -> str | None:
    """Where the link `target` of a project's file leads on the site, relative to the page; None: to no page."""
    path, _, anchor = target.partition("#")
    wanted = posixpath.normpath(posixpath.join(posixpath.dirname(file), path))
    if wanted.startswith("docs/") or wanted in PLACES:
        here = PLACES.get(file, file.removeprefix("docs/"))
        there = PLACES.get(wanted, wanted.removeprefix("docs/"))
        return posixpath.relpath(there, posixpath.dirname(here) or ".") + (f"#{anchor}" if anchor else "")
    return None


def on_files(files, config):
    from mkdocs.structure.files import File  # the rest of this file is read without MkDocs, by the tests

    for page, text in generated().items():
        files.append(File.generated(config, page, content=text))
    for path in sorted(EXECUTED.glob("*.ipynb")):
        files.append(File.generated(config, f"notebooks/{path.name}", content=path.read_text(encoding="utf-8")))
    worker = (ROOT / "docs/site/iframe-worker.js").read_text(encoding="utf-8")
    files.append(File.generated(config, "assets/iframe-worker.js", content=worker))
    style = (ROOT / "docs/site/extra.css").read_text(encoding="utf-8")
    files.append(File.generated(config, "assets/extra.css", content=style))
    return files


def on_page_markdown(markdown, page, config, files):
    uri = page.file.src_uri
    file = next((file for file, place in PLACES.items() if place == uri), f"docs/{uri}")

    def link(match):
        if match["target"].startswith(("#", "http://", "https://", "mailto:")):
            return match[0]
        place = site_link(file, match["target"])
        return f"{match['image']}[{match['text']}]({place})" if place else match["text"]

    return re.sub(r"(?P<image>!?)\[(?P<text>[^\]\n]+)\]\((?P<target>[^)\s]+)\)", link, markdown)


def on_page_content(html, page, config, files):
    from mkdocs.exceptions import PluginError

    try:
        return rendered(html)
    except ValueError as error:
        raise PluginError(f"{page.file.src_uri}: {error}") from error


def on_post_build(config):
    """No page may load anything from elsewhere."""
    from mkdocs.exceptions import PluginError

    loads = re.compile(r'<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)="?((?:https?:)?//[^"\s>]+)')
    for path in sorted(Path(config.site_dir).rglob("*.html")):
        addresses = loads.findall(path.read_text(encoding="utf-8"))
        if addresses:
            name = os.path.relpath(path, config.site_dir)
            raise PluginError(f"{name} loads {addresses[0]}: the site must be complete by itself.")
