"""Who may import whom, what the modules of the mathematics may not do, and that `import hilbo` stays lazy."""

import ast
import importlib.util
import subprocess
import sys
from collections import Counter
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import hilbo

PACKAGE = Path(__file__).parents[1] / "hilbo"

# Who may import whom: a folder's own modules, or a file on top, may import these and what these may import. Everybody
# may import errors.
MAY_IMPORT = {
    "errors": set(),
    "programs": set(),
    "numerics": set(),
    "kernels": {"numerics"},
    "bcm": {"numerics"},
    "likelihoods": {"numerics"},
    "acquisition": {"likelihoods"},
    "gaussian": {"numerics"},
    "newton_steps": {"gaussian"},
    "laplace": {"newton_steps"},
    "trials": {"numerics"},
    "inference": {"laplace"},
    "fitting_input": {"kernels", "likelihoods", "trials"},
    "ordinal_gp": {"inference", "fitting_input"},
    "hyperparameters": {"ordinal_gp"},
    "population.shared": {"ordinal_gp"},
    "population.rules": set(),
    "population.learnt": {"population.rules", "population.shared"},
    "population": {"bcm", "population.learnt"},
    "population.judged": {"hyperparameters", "population"},
    "mechanics": {"numerics"},
    "viscoelastic": {"mechanics"},
    "passivity": {"viscoelastic"},
    "search": {"passivity", "kernels"},
    "study.disk": set(),
    "study.formats": {"search"},
    "study.file": {"population.rules", "study.formats"},
    "study.tables": {"study.file"},
    "study.importing": {"study.tables"},
    "study": {"population.judged", "study.importing"},
    "study.estimate": {"acquisition", "study"},
    "study.results": {"study", "study.disk"},
    "study.robustness": {"hyperparameters", "study.estimate"},
    "study.analysis": {"study.robustness"},
    "statistics": {"study.tables"},
    "session.log": {"study.disk", "study.file"},
    "session.export": {"session.log", "study.tables"},
    "session.choose": {"acquisition", "session.log", "study.results"},
    "session.plan": {"session.log", "study.analysis", "study.results"},
    "session.withdrawal": {"session.plan"},
    "simulation": {"session.choose", "session.plan"},
    "device": {"mechanics"},
    "device.local": {"device", "programs"},
    "hardware_bridge": {"device.local"},
    "identification.tables": {"study.formats"},
    "identification": {"identification.tables", "study.tables"},
    "identification.motor": {"hardware_bridge"},
    "report.figures": {"identification", "study.analysis"},
    "report": {"report.figures", "statistics", "simulation"},
    "report.study": {"report"},
    "app.wire": {"study.disk", "study.formats"},
    "app.rigs": {"app.wire", "hardware_bridge", "session.plan"},
    "app": {"app.rigs"},
    "app.pages": {"app", "session.choose"},
    "app.hub": {"app.pages"},
    "app.server": {"app.hub"},
    "app.rehearsal": {"app.wire", "device.local", "simulation"},
    "cli.terminal": {"programs", "report.figures", "study.results"},
    "cli.device": {"cli.terminal", "identification.motor"},
    "cli": {"app.rehearsal", "app.server", "cli.device", "report.study", "session.export", "session.withdrawal"},
}
MOST_MODULES = 16  # in a folder, __init__ not counted
MOST_ENTRIES = 32  # of hilbo/
# What types say too little of. These numbers only go down.
MOST_ANY = 628  # mentions of Any
MOST_BARE = 386  # functions with a parameter that has no annotation
# The mathematics: no files, clock, printing or environment.
MATHS = {
    *("kernels", "bcm", "numerics", "acquisition", "likelihoods", "gaussian", "laplace", "inference", "ordinal_gp"),
    *("trials", "fitting_input", "newton_steps"),
    *("hyperparameters", "population", "mechanics", "viscoelastic", "passivity", "search"),
    *(f"statistics.{name}" for name in ("ordered_logit", "separation", "cluster_robust", "regression")),
    *(
        f"identification.{name}"
        for name in (
            *("fitting", "sampled", "moduli", "intervals", "residual_noise", "characterise"),
            *("instrument", "misfit", "beginnings", "screening", "estimates", "sentences"),
            *("motor.friction", "motor.friction_laws"),
        )
    ),
    *(f"study.analysis.{name}" for name in ("best_mid_worst", "tolerance")),
    *("session.choose.selection", "session.choose.ask_tell", "simulation.simulate"),
}
ASKS_THE_PROCESS = {"numerics.compiling"}  # which flags XLA was given
ONLY_IN = {"matplotlib": {"report.figures"}, "serial": {"device.ports"}}
WITHOUT_JAX = {
    *("errors", "device", "hardware_bridge", "identification.motor", "cli.device"),
    *("app.wire", "app.rigs", "app.server"),
    *("population.rules", "study.disk", "study.formats", "study.file", "study.tables", "study.importing"),
    *("session.log", "session.export", "session.plan", "session.withdrawal"),
    *("mechanics.span", "search.box", "report.json_text", "app.pages.pace", "app.pages.session_views"),
}
# These import JAX for a set with full memory, to convert a value, and for a validation, and not before.
LATER = {"device.parameter_sets", "search.box", "session.plan.validation_sets"}
OUTSIDE_WORLD = {"os", "io", "sys", "time", "datetime", "pathlib", "logging", "random", "socket", "subprocess"}
MAY_ENABLE_X64 = {"cli.terminal.console", "app"}
PARSERS = {"tomllib.loads", "json.load", "json.loads", "msgspec.json.decode", "msgspec.msgpack.decode"}
# These read what is hilbo's own: data of the package, a study's checked content, its own server, kept programs.
READ_THEIR_OWN = {
    *("simulation.presets", "simulation.power", "study.file.languages", "study.file.reading", "study.folder"),
    *("cli.doctor", "cli.device.commands", "app.server.server", "app.rehearsal.robot", "app.rehearsal.rehearsal"),
    "programs.entries",
}
SAYS_NOTHING = {"found", "told", "told_of", "gone"}  # as names: what is it that was found?
LONGEST = 400  # lines


def module_of(path: Path) -> str:
    """Dotted name below hilbo: `hilbo/bcm.py` is bcm, `hilbo/study/config.py` study.config."""
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")


def place_of(name: str) -> str:
    """The folder, or the file on top, in which a module lives, or what is imported from one: what the table names."""
    while name not in FOLDERS and name not in MODULES and "." in name:
        name = name.rpartition(".")[0]  # a name in a module
    return name if name in FOLDERS else name.rpartition(".")[0] or name


def among(module: str, names: set[str]) -> bool:
    """Whether the names hold a module, or a folder that it is in."""
    parts = module.split(".")
    return any(".".join(parts[: n + 1]) in names for n in range(len(parts)))


SOURCES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")
FOLDERS = {module_of(path) for path in SOURCES if path.name == "__init__.py"}
MODULES = {module_of(path) for path in SOURCES} - FOLDERS
each_source = pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))


def imports(tree: ast.AST) -> set[str]:
    """Dotted names of all imported modules, also those within functions; `from hilbo import bcm` is hilbo.bcm."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            names |= set() if base == "hilbo" else {base}
            if base.split(".")[0] == "hilbo":  # what is imported may be a module
                names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def below(place: str) -> set[str]:
    """Everything that a folder or file may import: what the table says, and what that may import; and the folders
    around them, whose own text is a docstring."""
    allowed, ahead = {"errors", place}, [place]
    while ahead:
        direct = MAY_IMPORT.get(ahead.pop(), set())
        ahead += direct - allowed
        allowed |= direct
    return allowed | {name.split(".")[0] for name in allowed if name.split(".")[0] not in MAY_IMPORT}


def siblings(tree: ast.AST) -> set[str]:
    """Dotted names below hilbo that are imported. The version is no module."""
    return {name.removeprefix("hilbo.") for name in imports(tree) if name.startswith("hilbo.")} - {"__version__"}


def faults(module: str, source: str) -> list[str]:
    """Everything in which a module breaks the rules of this file, one sentence each."""
    tree = ast.parse(source)
    packages = {name.split(".")[0] for name in imports(tree)}
    places = {place_of(name) for name in siblings(tree)}
    listed = [f"imports hilbo.{place}" for place in sorted(places - below(place_of(module)))]
    if place_of(module) not in MAY_IMPORT and module not in FOLDERS:
        listed.append("is not in the table of test_architecture.py")
    if "" in packages:
        listed.append("has a relative import")
    listed += [f"imports {name}" for name, users in ONLY_IN.items() if name in packages and not among(module, users)]
    if among(module, WITHOUT_JAX) and not among(module, LATER):
        listed += [f"imports {name}" for name in packages & {"jax", "jaxlib", "equinox"}]
    if among(module, MATHS) and module not in ASKS_THE_PROCESS:
        listed += [f"imports {name}" for name in packages & OUTSIDE_WORLD]
        calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
        listed += [f"calls {f.id}" for f in calls if isinstance(f, ast.Name) and f.id in {"print", "open", "input"}]
    if "enable_x64" in source and not among(module, MAY_ENABLE_X64):
        listed.append("switches 64-bit numbers on, or talks of it")
    listed += [f"binds {name}, which does not say what it holds" for name in sorted(bound(tree) & SAYS_NOTHING)]
    if source.count("\n") > LONGEST:
        listed.append(f"has more than {LONGEST} lines")
    return listed + public_faults(module, tree)


def bound(tree: ast.AST) -> set[str]:
    """Every name that a module gives: variables, attributes, parameters, functions, classes, aliases, captures."""
    named = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.ExceptHandler | ast.MatchAs | ast.MatchStar
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.alias):
            names.add(node.asname)
        elif isinstance(node, named):
            names.add(node.name)
    return names


def public_faults(module: str, tree: ast.Module) -> list[str]:
    """A public module says what it is for, and which of its names are public."""
    listed = [] if ast.get_docstring(tree) else ["has no docstring"]
    if module in FOLDERS:
        return listed if len(tree.body) == 1 else [*listed, "has more than a docstring"]
    if module.startswith("app."):
        return listed
    exported = None
    for node in tree.body:
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__all__"]:
            exported = ast.literal_eval(node.value)
    if exported is None:
        return [*listed, "has no __all__"]
    defined = {name for node in tree.body for name in names_bound(node)}
    return listed + [f"exports {name}, which it does not define" for name in exported if name not in defined]


def names_bound(node: ast.stmt) -> set[str]:
    """Names that a statement at the top of a module brings into being."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return {node.name}
    if isinstance(node, ast.Import | ast.ImportFrom):
        return {alias.asname or alias.name for alias in node.names}
    return {name.id for name in ast.walk(node) if isinstance(name, ast.Name) and isinstance(name.ctx, ast.Store)}


@each_source
def test_a_module_keeps_the_rules(path):
    assert faults(module_of(path), path.read_text(encoding="utf-8")) == []


def test_the_modules_have_been_found():
    assert {"errors", "kernels", "study.cohort", "search"} <= {module_of(path) for path in SOURCES}


def test_folders_are_small():
    """The list of folders is the architecture: each can be read at a glance."""
    entries = [path for path in PACKAGE.iterdir() if path.name != "__pycache__"]
    assert len(entries) <= MOST_ENTRIES, sorted(entries)
    modules = Counter(place_of(name) for name in MODULES if "." in name)
    assert {folder: count for folder, count in modules.items() if count > MOST_MODULES} == {}


def test_types_say_more_than_before():
    mentions = bare = 0
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            mentions += isinstance(node, ast.Name) and node.id == "Any"
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                bare += any(arg.annotation is None for arg in every if arg.arg not in ("self", "cls"))
    assert (mentions <= MOST_ANY, bare <= MOST_BARE) == (True, True), (mentions, bare)


def unguarded_parsers(tree):
    """Calls of parsers outside of a `try` that catches all that they raise."""
    guarded = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Try) and any("UNREADABLE" in ast.unparse(h.type) for h in node.handlers if h.type):
            guarded |= {id(call) for part in node.body for call in ast.walk(part)}
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call) and id(node) not in guarded)
    return [call for call in calls if ast.unparse(call.func) in PARSERS]


def test_what_a_parser_raises_is_caught_whole():
    """A number of 5,000 digits and lists within lists are no syntax errors."""
    found = {module_of(path) for path in SOURCES if unguarded_parsers(ast.parse(path.read_text(encoding="utf-8")))}
    assert found == READ_THEIR_OWN | {"study.formats.parsing"}  # which has handlers of its own


def test_no_cycles():
    TopologicalSorter(MAY_IMPORT).prepare()  # raises CycleError
    graph = {}
    for path in SOURCES:
        taken = siblings(ast.parse(path.read_text(encoding="utf-8")))
        # `from hilbo.study import cohort` names the folder as well as the file in it: the file counts.
        graph[module_of(path)] = taken & MODULES
    TopologicalSorter(graph).prepare()


def test_every_arrow_of_the_table_is_used():
    used = {}
    for path in SOURCES:
        place = place_of(module_of(path))
        used.setdefault(place, set()).update(map(place_of, siblings(ast.parse(path.read_text(encoding="utf-8")))))
    assert {place: sorted(direct - used[place]) for place, direct in MAY_IMPORT.items() if direct - used[place]} == {}


HEAD = '"""Doc."""\n__all__ = []\n'


@pytest.mark.parametrize(
    ("module", "source", "fault"),
    [
        ("kernels", HEAD + "from hilbo.laplace import laplace\n", "imports hilbo.laplace"),
        ("ordinal_gp", HEAD + "from hilbo import bcm, errors, kernels, laplace\n", "imports hilbo.bcm"),
        ("study.cohort", HEAD + "def f():\n    import hilbo.session\n", "imports hilbo.session"),
        ("study.cohort", HEAD + "from hilbo.session.choose.selection import design\n", "imports hilbo.session.choose"),
        ("session.log.state", HEAD + "from hilbo.session.plan import plan\n", "imports hilbo.session.plan"),
        ("kernels", HEAD + "from . import errors\n", "has a relative import"),
        ("cli.main", HEAD + "import matplotlib.pyplot\n", "imports matplotlib"),
        ("hardware_bridge", HEAD + "import jax.numpy\n", "imports jax"),
        ("device.link", HEAD + "import jax\n", "imports jax"),
        ("bcm", HEAD + "from os import environ\n", "imports os"),
        ("search.space", HEAD + "print(1)\n", "calls print"),
        ("bcm", HEAD + "jax.config.update('jax_enable_x64', True)\n", "switches 64-bit numbers on, or talks of it"),
        ("bcm", HEAD + "\n" * LONGEST, "has more than 400 lines"),
        *(
            ("bcm", HEAD + given, "binds found, which does not say what it holds")
            for given in (
                "found = 1\n",
                "found: int\n",
                "a.found = 1\n",
                "for a, found in b:\n    pass\n",
                "a = [found for found in b]\n",
                "if found := 1:\n    pass\n",
                "with a as found:\n    pass\n",
                "def f(*, found):\n    pass\n",
                "a = lambda found: 1\n",
                "async def found():\n    pass\n",
                "import ast as found\n",
                "try:\n    pass\nexcept OSError as found:\n    pass\n",
                "match a:\n    case found:\n        pass\n",
            )
        ),
        ("bcm", "__all__ = []\n", "has no docstring"),
        ("bcm", '"""Doc."""\n', "has no __all__"),
        ("bcm", '"""Doc."""\n__all__ = ["combine"]\n', "exports combine, which it does not define"),
        ("search", '"""Doc."""\nA = 1\n', "has more than a docstring"),
        ("extra.module", HEAD, "is not in the table of test_architecture.py"),
    ],
)
def test_each_rule_can_fail(module, source, fault):
    assert faults(module, source) == [fault]


def test_a_module_in_order_has_no_fault():
    source = '"""Doc."""\nfrom hilbo import viscoelastic\nfrom hilbo.errors import InputError\n__all__ = ["A"]\nA = 1\n'
    assert faults("passivity", source) == []
    assert faults("session.plan.plan", source) == []


@pytest.mark.parametrize("name", hilbo.__all__)
def test_a_public_name_resolves(name):
    assert getattr(hilbo, name) is not None


def test_type_checkers_see_the_same_names():
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    names = {alias.asname for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert names == set(dir(hilbo)) and set(hilbo.__all__) <= names


@pytest.mark.parametrize("path", sorted((PACKAGE.parent / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_what_a_benchmark_takes_from_hilbo_is_there(path):
    # Benchmarks import inside functions, and are run once in a while: a name that went would not be missed here.
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "hilbo":
            module = importlib.import_module(node.module)
            for alias in node.names:
                assert hasattr(module, alias.name) or importlib.util.find_spec(f"{node.module}.{alias.name}")


LIGHT = [
    "hilbo",
    "hilbo.errors",
    "hilbo.device.protocol",
    "hilbo.hardware_bridge",
    "hilbo.identification.motor.device_tests",
]


@pytest.mark.parametrize("module", [*LIGHT, "hilbo.cli.main"])
def test_importing_it_loads_no_jax(module):
    heavy = {"jax", "matplotlib", "pandas", "scipy"} | ({"numpy"} if module in ("hilbo", "hilbo.errors") else set())
    code = f"import sys, {module}; print(*sorted({heavy} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert run.stdout == "\n"


def test_protocols_can_be_checked_where_calls_are():
    """Deep tests check the types of arguments, and a protocol that is not made for it fails at import."""
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef) and any(ast.unparse(base) == "Protocol" for base in node.bases):
                assert "runtime_checkable" in map(ast.unparse, node.decorator_list), f"{path}: {node.name}"
