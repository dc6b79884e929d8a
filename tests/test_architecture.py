"""Who may import whom, what the modules of the mathematics may not do, and that `import hilbo` stays lazy."""

import ast
import importlib.util
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import hilbo

PACKAGE = Path(__file__).parents[1] / "hilbo"
EVERYWHERE = {"errors", "normal", "linalg"}  # may be imported by every module, and import nothing of hilbo

# The mathematics: no files, clock, printing or environment.
MATHS = {
    "normal": set(),
    "linalg": set(),
    "newton": set(),
    "kernels": set(),
    "likelihoods": set(),
    "gaussian": set(),
    "laplace": {"gaussian"},
    "evidence": {"gaussian", "laplace"},
    "ep_search": {"gaussian", "laplace"},
    "ep": {"gaussian", "ep_search"},
    "ep_evidence": {"ep_search", "evidence"},
    "ep_corrected": {"ep", "ep_search"},
    "sobol": set(),
    "tilting": {"likelihoods"},
    "exact": {"tilting", "sobol"},
    "bcm": set(),
    "acquisition": {"newton"},
    "lattice": {"kernels"},
    "mittag_leffler": set(),
    "exponentials": set(),
    "memory": {"exponentials"},
    "recursion": {"memory", "exponentials"},
    "fosls": {"recursion", "mittag_leffler"},
    "continuous": {"fosls"},
    "materials": {"fosls"},
    "switching": {"fosls"},
    "viscoelastic": {"fosls", "continuous", "materials", "switching"},
    "aggregation": {"bcm"},
    "ordinal_gp": {"kernels", "likelihoods", "laplace", "ep_corrected", "exact"},
    "hierarchical": {"kernels", "ordinal_gp"},
    "joint": {"kernels", "ordinal_gp"},
    "counts": {"kernels", "likelihoods", "gaussian", "ordinal_gp"},
    "learn_people": {"counts"},
    "population_rules": {"aggregation", "hierarchical", "counts", "ordinal_gp"},
    "leave_one_out": {"population_rules"},
    "hyper_coordinates": {"ordinal_gp"},
    "hyper_cost": {"hyper_coordinates", "ordinal_gp", "newton", "ep_evidence", "kernels"},
    "hyperparameters": {"hyper_cost", "newton"},
    "passivity_certificate": {"viscoelastic"},
    "passivity": {"viscoelastic", "passivity_certificate"},
    "least_squares": set(),
    "identification": {"least_squares"},
    "sampled": {"identification"},
    "moduli": {"identification", "mittag_leffler"},
    "intervals": {"identification", "least_squares"},
    "memory_selection": {"sampled"},
    "characterise": {"intervals", "memory_selection", "moduli", "passivity"},
    "space_filling": set(),
    "search_space": {"viscoelastic", "passivity", "space_filling"},
    "search_lattice": {"lattice", "search_space", "space_filling"},
    "trial_choice": {"config", "ordinal_gp", "acquisition", "lattice", "search_lattice"},
    "session": {"compiling", "config", "ordinal_gp", "trial_choice"},
    "simulate": {"trial_choice"},
    "validation": {"study", "config", "acquisition"},
    "ordered_logit": set(),
    "separation": {"ordered_logit"},
    "cluster_robust": set(),
    "wild_bootstrap": {"ordered_logit", "cluster_robust"},
    "regression": {"separation", "wild_bootstrap"},
    "statistics": {"regression"},
    "people": {"ordinal_gp"},
    "sensitivity": {"aggregation", "validation"},
}
# What each module may import of hilbo, and with it what that one may import. Modules to come have their place already.
MAY_IMPORT = MATHS | {
    "errors": set(),
    "compiling": set(),
    "frames": set(),
    "messages": set(),
    "reasons": set(),
    "protocol": {"frames", "messages", "reasons"},
    "ports": set(),
    "heartbeat": set(),
    "link": {"protocol", "frames", "messages", "reasons", "heartbeat"},
    "handshake": {"link"},
    "parameter_sets": {"protocol", "messages", "exponentials"},
    "staging": {"link", "parameter_sets"},
    "telemetry": {"messages"},
    "simulator": {"link"},
    "friction": set(),
    "pressing": {"link", "telemetry"},
    "device_tests": {"hardware_bridge", "friction", "pressing"},
    "set_tables": set(),
    "device_screen": {"hardware_bridge"},
    "device_words": set(),
    "study_tables": set(),
    "trial_protocols": {"study_tables"},
    "config": {"search_space", "ordinal_gp", "study_tables", "trial_protocols"},
    "counterbalance": set(),
    "live_records": {"trial_protocols"},
    "live_state": {"config", "live_records"},
    "live_session": {"live_state"},
    "live_views": {"live_session"},
    "live_choice": {"live_state", "session", "acquisition", "warm_start"},
    "logged_session": {"event_log", "live_choice", "live_session"},
    "warm_start": {"trial_choice"},
    "stopping": {"live_state", "session"},
    "study_plan": {"config", "counterbalance", "live_records", "people_table"},
    "plan_sets": {"study", "study_plan", "validation"},
    "log_tables": {"event_log", "tables"},
    "people_table": {"event_log"},
    "doctor": {"session", "ports", "link"},
    "cli_session": {"console", "study_plan", "plan_sets", "log_tables", "people_table"},
    "tables": {"config"},
    "material_tables": {"tables", "identification"},
    "validation_table": {"tables"},
    "preferences": {"statistics", "validation_table"},
    "paper_tables": {"preferences"},
    "analysis": {"study", "validation", "sensitivity", "people", "hyperparameters", "rule_words"},
    "inference_data": {"study", "kernels"},
    "study_folder": {"study", "validation_table"},
    "power": {"study", "simulate"},
    "console": {"compiling"},
    "cli_material": {"console", "characterise", "material_tables", "report_material"},
    "study": {"tables", "trial_choice", "simulate", "ordinal_gp", "hyperparameters", "bcm", "population_rules"},
    "rule_words": {"config", "population_rules"},
    "comparison": {"study", "trial_choice", "joint", "leave_one_out", "rule_words"},
    "plotting_population": {"plotting"},
    "event_log": {"live_state"},
    "distributed": set(),
    "batch": {"study", "distributed", "gaussian", "kernels"},
    "batch_optimum": {"batch", "newton"},
    "robustness": {"study", "hyperparameters"},
    "plotting": set(MATHS) | {"study"},
    "plotting_mechanics": {"plotting", "characterise"},
    "plotting_validation": {"plotting"},
    "plotting_power": {"plotting"},
    "plotting_study": {"plotting", "analysis"},
    "report_people": {"study"},
    "page": {"config", "report_people"},
    "hardware_bridge": {"ports", "handshake", "staging", "telemetry", "simulator"},
    "device_options": {"console", "hardware_bridge", "set_tables", "config", "viscoelastic"},
    "device_results": set(),
    "cli_measure": {"device_options", "device_results", "device_tests"},
    "cli_device": {"cli_measure", "device_options", "device_results", "device_tests", "device_screen", "device_words"},
}
_COMMANDS = {"console", "cli_material", "cli_session", "device_options", "cli_measure", "cli_device"}
MAY_IMPORT["report"] = set(MAY_IMPORT) - _COMMANDS
MAY_IMPORT["report_comparison"] = {"report", "comparison", "plotting_population"}
MAY_IMPORT["report_population"] = {"report", "report_people", "page", "batch_optimum"}
MAY_IMPORT["report_robustness"] = {"report"}
MAY_IMPORT["simulate_validation"] = {"report", "simulate", "validation"}
MAY_IMPORT["report_validation"] = {"report", "page", "paper_tables", "plotting_validation"}
MAY_IMPORT["report_power"] = {"report", "page", "power", "plotting_power"}
MAY_IMPORT["report_figures"] = {"analysis", "study_folder", "plotting_study", "plotting_population", "rule_words"}
MAY_IMPORT["hypotheses"] = {"analysis", "report_validation"}
MAY_IMPORT["report_study"] = {
    "hypotheses",
    "inference_data",
    "report_comparison",
    "report_figures",
    "report_validation",
    "study_folder",
}
MAY_IMPORT["report_material"] = {"report", "page", "plotting_mechanics", "characterise"}
MAY_IMPORT["cli_study"] = {"console", "power", "report_power", "report_study", "simulate_validation"}
MAY_IMPORT["app"] = set(MAY_IMPORT)
MAY_IMPORT["cli_live"] = {"app", "doctor"}
MAY_IMPORT["cli"] = set(MAY_IMPORT)
MAY_IMPORT["__main__"] = {"cli"}

PLOTTING = {"plotting", *(f"plotting_{of}" for of in ("mechanics", "population", "power", "study", "validation"))}
ONLY_IN = {"matplotlib": PLOTTING, "serial": {"ports"}}
WITHOUT_JAX = {
    "errors",
    "protocol",
    "hardware_bridge",
    "heartbeat",
    "link",
    "ports",
    "simulator",
    "telemetry",
    "device_tests",
    "device_screen",
    "cli_measure",
    "cli_device",
}
OUTSIDE_WORLD = {"os", "io", "sys", "time", "datetime", "pathlib", "logging", "random", "socket", "subprocess"}
MAY_ENABLE_X64 = {"console", "app", "__main__"}
LONGEST = 400  # lines


def module_of(path: Path) -> str:
    """Name in the table: `hilbo/bcm.py` is bcm, everything below `hilbo/app/` is app."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


SOURCES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")
each_source = pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))


def imports(tree: ast.AST) -> set[str]:
    """Dotted names of all imported modules, also those within functions; `from hilbo import bcm` is hilbo.bcm."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = "." * node.level + (node.module or "")
            found |= {f"hilbo.{alias.name}" for alias in node.names} if base == "hilbo" else {base}
    return found


def below(module: str) -> set[str]:
    """Every module that this one may import: what the table says, and what is below that."""
    found, ahead = set() if module in EVERYWHERE else set(EVERYWHERE), [module]
    while ahead:
        direct = MAY_IMPORT.get(ahead.pop(), set())
        ahead += direct - found
        found |= direct
    return found


def siblings(tree: ast.AST) -> set[str]:
    """Modules of hilbo that are imported. The version is no module."""
    return {name.split(".")[1] for name in imports(tree) if name.startswith("hilbo.")} - {"__version__"}


def faults(module: str, source: str) -> list[str]:
    """Everything in which a module breaks the rules of this file, one sentence each."""
    tree = ast.parse(source)
    packages = {name.split(".")[0] for name in imports(tree)}
    found = [f"imports hilbo.{name}" for name in siblings(tree) - below(module) - {module}]
    if module not in MAY_IMPORT:
        found.append("is not in the table of test_architecture.py")
    if "" in packages:
        found.append("has a relative import")
    found += [f"imports {name}" for name, users in ONLY_IN.items() if name in packages and module not in users]
    if module in WITHOUT_JAX:
        found += [f"imports {name}" for name in packages & {"jax", "jaxlib", "equinox"}]
    if module in MATHS:
        found += [f"imports {name}" for name in packages & OUTSIDE_WORLD]
        calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
        found += [f"calls {f.id}" for f in calls if isinstance(f, ast.Name) and f.id in {"print", "open", "input"}]
    if "enable_x64" in source and module not in MAY_ENABLE_X64:
        found.append("switches 64-bit numbers on, or talks of it")
    if source.count("\n") > LONGEST:
        found.append(f"has more than {LONGEST} lines")
    return found + public_faults(module, tree)


def public_faults(module: str, tree: ast.Module) -> list[str]:
    """A public module says what it is for, and which of its names are public."""
    if module.startswith("_") or module == "app":
        return []
    found = [] if ast.get_docstring(tree) else ["has no docstring"]
    exported = None
    for node in tree.body:
        if isinstance(node, ast.Assign) and [ast.unparse(target) for target in node.targets] == ["__all__"]:
            exported = ast.literal_eval(node.value)
    if exported is None:
        return [*found, "has no __all__"]
    defined = {name for node in tree.body for name in names_bound(node)}
    return found + [f"exports {name}, which it does not define" for name in exported if name not in defined]


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
    assert {"errors", "kernels", "laplace"} <= {module_of(path) for path in SOURCES}


def test_no_cycles():
    TopologicalSorter(MAY_IMPORT).prepare()  # raises CycleError
    graph = {}
    for path in SOURCES:
        module = module_of(path)
        graph.setdefault(module, set()).update(siblings(ast.parse(path.read_text(encoding="utf-8"))) - {module})
    TopologicalSorter(graph).prepare()


HEAD = '"""Doc."""\n__all__ = []\n'


@pytest.mark.parametrize(
    ("module", "source", "fault"),
    [
        ("kernels", HEAD + "from hilbo.laplace import laplace\n", "imports hilbo.laplace"),
        ("ordinal_gp", HEAD + "from hilbo import bcm, errors, kernels, normal\n", "imports hilbo.bcm"),
        ("normal", HEAD + "from hilbo.errors import InputError\n", "imports hilbo.errors"),
        ("session", HEAD + "def f():\n    import hilbo.study\n", "imports hilbo.study"),
        ("kernels", HEAD + "from . import errors\n", "has a relative import"),
        ("cli", HEAD + "import matplotlib.pyplot\n", "imports matplotlib"),
        ("hardware_bridge", HEAD + "import jax.numpy\n", "imports jax"),
        ("bcm", HEAD + "from os import environ\n", "imports os"),
        ("simulate", HEAD + "print(1)\n", "calls print"),
        ("bcm", HEAD + "jax.config.update('jax_enable_x64', True)\n", "switches 64-bit numbers on, or talks of it"),
        ("bcm", HEAD + "\n" * LONGEST, "has more than 400 lines"),
        ("bcm", "__all__ = []\n", "has no docstring"),
        ("bcm", '"""Doc."""\n', "has no __all__"),
        ("bcm", '"""Doc."""\n__all__ = ["combine"]\n', "exports combine, which it does not define"),
        ("extra", HEAD, "is not in the table of test_architecture.py"),
    ],
)
def test_each_rule_can_fail(module, source, fault):
    assert faults(module, source) == [fault]


def test_a_module_in_order_has_no_fault():
    source = '"""Doc."""\nfrom hilbo import viscoelastic\nfrom hilbo.errors import InputError\n__all__ = ["A"]\nA = 1\n'
    assert faults("passivity", source) == []
    assert faults("session", source) == []


@pytest.mark.parametrize("name", hilbo.__all__)
def test_a_public_name_resolves(name):
    assert getattr(hilbo, name) is not None


def test_type_checkers_see_the_same_names():
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    names = {alias.asname for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert names == set(hilbo.__all__)


@pytest.mark.parametrize("path", sorted((PACKAGE.parent / "benchmarks").glob("*.py")), ids=lambda path: path.stem)
def test_what_a_benchmark_takes_from_hilbo_is_there(path):
    # Benchmarks import inside functions, and are run once in a while: a name that went would not be missed here.
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "hilbo":
            module = importlib.import_module(node.module)
            for alias in node.names:
                assert hasattr(module, alias.name) or importlib.util.find_spec(f"{node.module}.{alias.name}")


LIGHT = ["hilbo", "hilbo.errors", "hilbo.protocol", "hilbo.hardware_bridge", "hilbo.device_tests", "hilbo.cli"]


@pytest.mark.parametrize("module", [name for name in LIGHT if (PACKAGE / f"{name[6:] or '__init__'}.py").exists()])
def test_importing_it_loads_no_jax(module):
    heavy = {"jax", "matplotlib", "pandas", "scipy"} | ({"numpy"} if module in ("hilbo", "hilbo.errors") else set())
    code = f"import sys, {module}; print(*sorted({heavy} & set(sys.modules)))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert run.stdout == "\n"
