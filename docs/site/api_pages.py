"""The pages of the API reference: first the objects of the package, then its modules, each object where it is defined.

Modules are read, not imported.
"""

import ast
import re
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "hilbo"

# A page of the API reference: its title, and the modules in the order of reading.
API = {
    "model": ("The model", "ordinal_gp trials kernels likelihoods acquisition numerics.climbing errors"),
    "inference": ("Inference and hyperparameters", "laplace gaussian inference.exact hyperparameters.maximum_evidence"),
    "aggregation": (
        "Aggregation",
        "study.cohort study.analysis.prediction report.figures.on_axes bcm study.estimate.aggregate"
        " study.estimate.optimum study.analysis.best_mid_worst"
        " study.analysis.tolerance study.analysis.rule_comparison population.pointwise population.shared.hierarchical"
        " population.learnt.rule population.judged.response_quality",
    ),
    "mechanics": (
        "Mechanics and search space",
        "viscoelastic mechanics.fosls mechanics.memory mechanics.materials mechanics.continuous mechanics.switching"
        " passivity mechanics.passivity_certificate mechanics.delay search.space search.columns search.candidates",
    ),
    "identification": (
        "Identification",
        "identification.material_tables identification.sampled identification.fitting identification.intervals"
        " identification.residual_noise identification.instrument identification.misfit"
        " identification.motor.friction_laws identification.moduli identification.characterise report.material",
    ),
    "sessions": (
        "Studies and sessions",
        "study.config session.choose.ask_tell session.choose.logged_session session.log.header session.plan.plan"
        " session.log.actions session.log.state session.log.event_log session.choose.look_ahead"
        " app.pages.session_views session.choose.warm_start",
    ),
    "simulation": (
        "Simulation",
        "simulation.presets simulation.simulate simulation.validation_sessions simulation.power",
    ),
    "reports": (
        "Tables, statistics, reports",
        "study.tables.trials study.folder study.tables.validation statistics.paper_tables statistics.logits"
        " statistics.preferences report.study.comparison report.study.report report.study.result_tables",
    ),
    "device": (
        "Device",
        "hardware_bridge device.protocol device.ports device.local.simulator device.local.library device.local.motor",
    ),
}


def objects() -> str:
    """The page of what `hilbo` itself offers: its objects, then its modules, with the first sentence of each."""
    place, modules = _exported()
    documented = {f"hilbo.{name}" for _, names in API.values() for name in names.split()}
    lines = ["# The public objects", "", _OPENING, "", "| object | what it is |", "|---|---|"]
    for name in _listed(PACKAGE / "__init__.py"):
        module, node = _definition(place[name], name)
        lines.append(f"| [`{name}`][{module}.{name}] | {_sentence(node)} |")
    lines += ["", "## Modules", "", "| module | what it has |", "|---|---|"]
    for name in modules:
        shown = f"[`hilbo.{name}`][hilbo.{name}]" if f"hilbo.{name}" in documented else f"`hilbo.{name}`"
        lines.append(f"| {shown} | {_sentence(_tree(f'hilbo.{name}'))} |")
    return "\n".join(lines) + "\n"


_OPENING = """`from hilbo import …` brings these; everything else is reached by its module. [Your own tables in
Python](../guides/in-python.md) and the [quick start](../notebooks/quick_start.md) use them on data."""


def reference(title: str, modules: str) -> str:
    """A page of the API reference: of each module what it defines itself, and not what it passes on of others."""
    return f"# {title}\n\n" + "\n".join(_block(f"hilbo.{module}") for module in modules.split())


def _block(module: str) -> str:
    """The directive of mkdocstrings for a module: the objects of the package first."""
    first = _listed(PACKAGE / "__init__.py")
    own = sorted((name for name in _public(module) if name in _defined(module)), key=lambda name: name not in first)
    return f"::: {module}\n    options:\n      members: [{', '.join(own)}]\n"


def _public(module: str) -> list[str]:
    """The names that a module lists in `__all__`, or all without an underscore."""
    return _listed(_file(module)) or [name for name in _defined(module) if not name.startswith("_")]


def _file(module: str) -> Path:
    path = PACKAGE.parent / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(_file(module).read_text(encoding="utf-8"))


@cache
def _defined(module: str) -> dict[str, ast.stmt]:
    """Name -> statement, of what a module defines itself."""
    found = {}
    for node in _tree(module).body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            found[node.name] = node
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found |= {target.id: node for target in targets if isinstance(target, ast.Name)}
    return found


def _listed(path: Path) -> list[str]:
    """`__all__` of a file, or nothing."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return ast.literal_eval(node.value)
    return []


def _exported() -> tuple[dict[str, str], list[str]]:
    """Object of the package -> the module that it is taken from; and the package's modules."""
    call = next(
        node for node in ast.walk(_tree("hilbo")) if isinstance(node, ast.Call) and "attach" in ast.unparse(node.func)
    )
    given = {word.arg: ast.literal_eval(word.value) for word in call.keywords}
    place = {name: f"hilbo.{module}" for module, names in given["submod_attrs"].items() for name in names}
    return place, given["submodules"]


def _definition(module: str, name: str) -> tuple[str, ast.stmt]:
    """The module that defines `name`, which `module` has defined or imported, and the statement."""
    if name in _defined(module):
        return module, _defined(module)[name]
    source = next(
        node.module
        for node in _tree(module).body
        if isinstance(node, ast.ImportFrom) and node.module and name in {alias.name for alias in node.names}
    )
    return _definition(source, name)


def _sentence(node) -> str:
    """The first paragraph of a docstring up to its first full stop or colon, for a cell of a table."""
    paragraph = " ".join((ast.get_docstring(node) or "").split("\n\n")[0].split())
    without_links = re.sub(r"\[(`\w+`)\]\[\]", r"\1", paragraph)
    return without_links.split(". ")[0].rstrip(".:").replace("|", "\\|")
