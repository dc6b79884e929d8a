"""What the API reference says of each public name: what it is, the shapes of its arrays, the errors that it raises."""

import ast
import importlib.util
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
SHAPED = re.compile(r"\b(Float|Int|UInt|Bool|Num|Real|Shaped|Key|PRNGKeyArray)\b")
ARRAYS = re.compile(r"\b(ArrayLike|Array|ndarray)\b")
_SIZE = r"\w{1,12}(?: ?[-+/] ?\w{1,4})?"
SHAPE = re.compile(rf"\((?:{_SIZE}, ?)+(?:{_SIZE})?\)|\bscalars?\b|elementwise|of any shape|\ban int\b")


class Said(NamedTuple):
    """A public name of the reference, and all docstrings that are shown with it: its own, and its class's."""

    place: str
    node: ast.AST
    docs: str
    helpers: dict[str, ast.AST]

    @property
    def own(self) -> str:
        return ast.get_docstring(self.node) or ""


def public(source: str, module: str = "m") -> Iterator[Said]:
    """The public functions, classes and methods of a module, and the constructors of classes."""
    tree = ast.parse(source)
    helpers = {node.name: node for node in tree.body if isinstance(node, FUNCTIONS) and node.name.startswith("_")}

    def names(body: list[ast.stmt], place: str, docs: str) -> Iterator[Said]:
        for node in body:
            if isinstance(node, (ast.ClassDef, *FUNCTIONS)) and not node.name.startswith("_"):
                said = f"{docs} {ast.get_docstring(node) or ''}"
                yield Said(f"{place}.{node.name}", node, said, helpers)
                if isinstance(node, ast.ClassDef):
                    yield from names(node.body, f"{place}.{node.name}", said)
            elif isinstance(node, ast.FunctionDef) and node.name == "__init__":
                yield Said(place, node, docs, helpers)

    yield from names(tree.body, module, "")


def silent(said: Said) -> bool:
    """Nothing is said of it. A constructor is described by its class."""
    return len(said.own) < 8 and getattr(said.node, "name", "") != "__init__"


def arguments(node: ast.AST) -> list[tuple[str, str]]:
    """Names and annotations of a function's arguments and result, without self."""
    if not isinstance(node, FUNCTIONS):
        return []
    given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    pairs = [(arg.arg, arg.annotation) for arg in given if arg.arg not in ("self", "cls")]
    pairs += [] if node.name == "__init__" else [("return", node.returns)]
    return [(name, "" if annotation is None else ast.unparse(annotation)) for name, annotation in pairs]


def untyped(said: Said) -> bool:
    """An argument, or the result, has no type."""
    return any(not annotation for _, annotation in arguments(said.node))


def shapeless(said: Said) -> bool:
    """An array whose annotation has no shape, and the docstring neither."""
    loose = [a for _, a in arguments(said.node) if ARRAYS.search(a) and not SHAPED.search(a)]
    return bool(loose) and not SHAPE.search(said.docs)


def raised(node: ast.AST, helpers: dict[str, ast.AST], seen: frozenset[str] = frozenset()) -> set[str]:
    """Errors that a function raises, by itself or by private functions of its module; not those that it catches."""
    if isinstance(node, ast.Try) and node.handlers:
        return set().union(*(raised(part, helpers, seen) for part in (*node.handlers, *node.orelse, *node.finalbody)))
    errors = set().union(*(raised(child, helpers, seen) for child in ast.iter_child_nodes(node)))
    if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
        errors.add(ast.unparse(node.exc.func))
    called = node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
    if called in helpers and called not in seen:
        errors |= raised(helpers[called], helpers, seen | {called})
    return errors


def unsaid(said: Said) -> bool:
    """It raises an error of its own accord, and neither it nor its class says so."""
    errors = {name for name in raised(said.node, said.helpers) if name.endswith("Error")}
    return isinstance(said.node, FUNCTIONS) and bool(errors) and not re.search(r"[Rr]aise|Error|[Rr]efuse", said.docs)


def reference() -> Iterator[Said]:
    """Every public name of the API reference."""
    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs" / "site" / "hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    for module in " ".join(names for _, names in hooks.API.values()).split():
        path = ROOT / "hilbo" / f"{module.replace('.', '/')}.py"
        yield from public(path.read_text(encoding="utf-8"), module)


@pytest.mark.parametrize("lacks", [silent, untyped, shapeless, unsaid])
def test_every_name_of_the_reference_says_what_its_user_needs(lacks: Callable[[Said], bool]):
    assert [said.place for said in reference() if lacks(said)] == []


@pytest.mark.parametrize(
    ("lacks", "source"),
    [
        (silent, "def f() -> None: ..."),
        (silent, 'class A:\n    """A thing of use."""\n    def f(self) -> None: ...'),
        (untyped, 'def f(x) -> None:\n    """Twice x."""'),
        (untyped, 'def f(x: int):\n    """Twice x."""'),
        (shapeless, 'def f(x: ArrayLike) -> None:\n    """Twice x, much more."""'),
        (shapeless, 'def f(x: ArrayLike) -> None:\n    """Twice x (by somebody, 1984)."""'),
        (shapeless, 'def f() -> np.ndarray:\n    """Twice x, much more."""'),
        (unsaid, 'def f(x: int) -> None:\n    """Twice x."""\n    raise InputError("x")'),
        (unsaid, 'def f(x: int) -> None:\n    """Twice x."""\n    _g(x)\ndef _g(x):\n    raise ValueError("x")'),
        (unsaid, 'class A:\n    """A thing."""\n    def __init__(self):\n        raise InputError("x")'),
    ],
)
def test_what_is_not_said_is_found(lacks: Callable[[Said], bool], source: str):
    assert [said for said in public(source) if lacks(said)]
    good = 'def f(x: ArrayLike) -> None:\n    """Twice x, (n, d). Raises `AnError`."""\n    raise AnError("x")'
    assert not [said for said in public(good) if lacks(said)]
