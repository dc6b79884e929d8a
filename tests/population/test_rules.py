"""The registry of the rules of aggregation: everything that takes a rule takes each, and nothing else lists them."""

import ast
import tomllib
from pathlib import Path

import jax.numpy as jnp
import pytest
import typer.main

import hilbo
from hilbo.cli.main import app
from hilbo.errors import InputError
from hilbo.population.maps import point_rule
from hilbo.population.rules.registry import DEFAULT, GIVEN, POINTWISE, RECIPES, RECOMMENDED, RULES, WITHDRAWN
from hilbo.report.page import estimate_words
from hilbo.report.registration import registration
from hilbo.session.plan.plan import make_plan
from hilbo.study.config import Study
from hilbo.study.estimate.learnt import by_rule
from hilbo.study.file.reading import StudyFile

PACKAGE = Path(hilbo.__file__).parent
PAPER = (PACKAGE / "data" / "paper.toml").read_text(encoding="utf-8")
each_rule = pytest.mark.parametrize("rule", RULES.values(), ids=list(RULES))


@each_rule
def test_a_study_file_takes_it(rule, tmp_path):
    text = PAPER.replace('rule = "bcm"', f'rule = "{rule.name}"')
    assert Study.from_dict(tomllib.loads(text)).rule == rule.name
    raw = tomllib.loads(text)
    del raw["gp"]
    if rule.learns:
        assert Study.from_dict(raw).stated.numbers == {}
    else:
        with pytest.raises(InputError, match=f'gp.theta is missing.*rule = "{RECOMMENDED}"'):
            Study.from_dict(raw)


@each_rule
def test_the_command_line_takes_it_and_names_it(rule):
    study = Study.from_dict(tomllib.loads(PAPER))
    assert by_rule(study, rule.name).rule == rule.name
    (option,) = (p for p in typer.main.get_command(app).commands["aggregate"].params if p.name == "rule")
    assert rule.name in option.help


@each_rule
def test_pages_describe_it(rule, tmp_path):
    assert estimate_words(rule.name, "another") == rule.label
    optimum = rule.optimum_for("close", True)
    assert "{" not in optimum + rule.optimum_for("similar", False)
    path = tmp_path / "study.toml"
    path.write_text(PAPER.replace('rule = "bcm"', f'rule = "{rule.name}"'), encoding="utf-8")
    study = StudyFile.load(path)
    page = registration(study, make_plan(study, ["P01", "P02"], 0), "1.2.3")
    assert f"{rule.description} (`{rule.name}`)" in page and optimum in page
    assert f'"{rule.name}"' in (PACKAGE.parent / "docs" / "guides" / "study-file.md").read_text(encoding="utf-8")


def test_facts_agree():
    assert len({rule.label for rule in RULES.values()}) == len(RULES) and DEFAULT in GIVEN and RECOMMENDED in RECIPES
    for name, rule in RULES.items():
        assert rule.name == name and rule.pointwise in POINTWISE and name not in WITHDRAWN
        assert rule.recipe is None or rule.recipe.name == name
        assert (point_rule(name, jnp.ones(()))[1] is not None) == RULES[rule.pointwise].learns_share
        assert not rule.exact_only or rule.joint


def names_in(node: ast.AST) -> set[str]:
    """Rules that a node names."""
    return {n.value for n in ast.walk(node) if isinstance(n, ast.Constant) and n.value in RULES}


def faults(tree: ast.AST) -> list[int]:
    """Lines that list rules, or compare a name with one."""
    lines = []
    for node in ast.walk(tree):
        listed = [node.elts] if isinstance(node, ast.Tuple | ast.List | ast.Set) else []
        listed += [list(filter(None, node.keys))] if isinstance(node, ast.Dict) else []
        several = any(sum(map(bool, map(names_in, entries))) > 2 for entries in listed)
        lines += [node.lineno] if several or (isinstance(node, ast.Compare) and names_in(node)) else []
    return lines


def test_no_other_module_lists_the_rules_or_branches_on_a_name():
    sources = set(PACKAGE.rglob("*.py")) - {PACKAGE / "population" / "rules" / "registry.py"}
    found_at = {path: faults(ast.parse(path.read_text(encoding="utf-8"))) for path in sources}
    assert {str(path): lines for path, lines in found_at.items() if lines} == {}


@pytest.mark.parametrize(
    "source", ['rule == "bcm"', '("bcm", "average", "pooled")', '{"bcm": 1, "average": 2, "pooled": 3}']
)
def test_a_list_or_a_branch_is_noticed(source):
    assert faults(ast.parse(source)) == [1] and faults(ast.parse('f("bcm", "average", "pooled")')) == []
