"""What `make docs` adds to the pages of docs/: notebooks, the API reference, and files that live elsewhere.

A page of docs/ links to a file of the project by its path, so that it reads well on a code host too. Here such a link
becomes one to the page that is made of the file, or plain text where the site has none.
"""

import os
import posixpath
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
FENCE = "```"

# A page of the API reference: its title, and the modules in the order of reading.
API = {
    "model": ("The model", "ordinal_gp kernels likelihoods acquisition errors"),
    "inference": ("Inference and hyperparameters", "laplace gaussian inference.exact hyperparameters.maximum_evidence"),
    "aggregation": (
        "Aggregation",
        "bcm study.cohort study.aggregate study.map_summary study.rule_comparison population.pointwise"
        " population.hierarchical population.learnt population.response_quality",
    ),
    "mechanics": (
        "Mechanics and search space",
        "viscoelastic mechanics.fosls mechanics.memory mechanics.materials mechanics.continuous mechanics.switching"
        " passivity mechanics.passivity_certificate search.space search.candidates",
    ),
    "identification": (
        "Identification",
        "identification.material_tables identification.sampled identification.fitting identification.intervals"
        " identification.moduli identification.characterise report.material",
    ),
    "sessions": (
        "Studies and sessions",
        "study.config session.ask_tell session.logged_session session.plan session.actions session.event_log"
        " session.look_ahead session.views session.warm_start",
    ),
    "simulation": (
        "Simulation",
        "simulation.presets simulation.simulate simulation.validation_sessions simulation.power",
    ),
    "reports": (
        "Tables, statistics, reports",
        "study.trial_table study.folder study.validation_table statistics.paper_tables statistics.logits"
        " statistics.preferences report.comparison report.study",
    ),
    "device": ("Device", "hardware_bridge device.protocol device.ports device.simulator"),
}
ELSEWHERE = {
    "README.md": "readme.md",
    "firmware/PROTOCOL.md": "device/protocol.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
NOTEBOOKS = {f"notebooks/{path.name}": f"notebooks/{path.stem}.md" for path in sorted(ROOT.glob("notebooks/*.py"))}
PLACES = ELSEWHERE | NOTEBOOKS  # file of the project -> page of the site


def generated() -> dict[str, str]:
    """Page of the site -> its Markdown, of all pages that docs/ does not hold."""
    text = {page: (ROOT / file).read_text(encoding="utf-8") for file, page in ELSEWHERE.items()}
    text |= {page: notebook(ROOT / file) for file, page in NOTEBOOKS.items()}
    return text | {f"api/{name}.md": reference(*entry) for name, entry in API.items()}


def notebook(path: Path) -> str:
    """A percent script as Markdown: its text cells, and its code cells in fences."""
    cells = re.split(r"(?m)^# %%", path.read_text(encoding="utf-8"))[1:]
    name = path.relative_to(ROOT)
    return "\n\n".join(map(_cell, cells)) + f"\n\nRun it with `python {name}`; editors show its cells.\n"


def _cell(cell: str) -> str:
    kind, _, body = cell.partition("\n")
    if kind.strip() == "[markdown]":
        return re.sub(r"(?m)^# ?", "", body).strip()
    return f"{FENCE}python\n{body.strip()}\n{FENCE}"


def reference(title: str, modules: str) -> str:
    """A page of the API reference."""
    return f"# {title}\n\n" + "\n\n".join(f"::: hilbo.{module}" for module in modules.split()) + "\n"


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


def on_post_build(config):
    """No page may load anything from elsewhere."""
    from mkdocs.exceptions import PluginError

    loads = re.compile(r'<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)="?((?:https?:)?//[^"\s>]+)')
    for path in sorted(Path(config.site_dir).rglob("*.html")):
        found = loads.findall(path.read_text(encoding="utf-8"))
        if found:
            name = os.path.relpath(path, config.site_dir)
            raise PluginError(f"{name} loads {found[0]}: the site must be complete by itself.")
