"""No parameter is called as a column of a table that has a column for each parameter: derived from these tables."""

import re
import tomllib
from inspect import unwrap
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
from live import STUDY, Driver
from studies import PLAIN

from hilbo import Study
from hilbo.errors import InputError
from hilbo.report.participants import People
from hilbo.report.results import moved, optima_table
from hilbo.report.study.comparison import comparison_table
from hilbo.report.study.dictionary import dictionary
from hilbo.report.study.page_tables import alternatives_rows
from hilbo.report.study.result_tables import alternatives_table
from hilbo.session.export.tables import sets_table, trials_table
from hilbo.simulation.simulate import to_table, truth_table
from hilbo.simulation.validation_sessions import sets_table as simulated_sets
from hilbo.study.analysis.best_mid_worst import Sets
from hilbo.study.file.reserved_names import is_reserved
from hilbo.study.results.map_netcdf import map_dataset
from hilbo.trials import Trials

ONE = np.array([0.5, 0.25])


def called(name):
    """A study with a parameter of this name, and another."""
    return Study.from_dict(PLAIN | {"parameters": {name: {"low": 0.0, "high": 1.0}, "v": {"low": 0.0, "high": 1.0}}})


def rendered(name):
    """The same beside those of a device's renderer."""
    raw = tomllib.loads(Path("hilbo/data/paper.toml").read_text())
    raw["parameters"][name] = {"low": 0.0, "high": 1.0}
    return Study.from_dict(raw)


def surface(x):
    return jnp.zeros(len(x)), jnp.ones(len(x))


def optimum(x=ONE):
    return SimpleNamespace(x=x, mean=0.75, sd=0.25, class_probabilities=np.array([0.2, 0.3, 0.5]))


def alternatives(study, x=ONE):
    aggregate = SimpleNamespace(optimum=optimum(x), alternatives={"ep": optimum(x)}, mean_of_optima=x)
    optimised = SimpleNamespace(aggregate=aggregate)
    analysis = SimpleNamespace(study=study, aggregate=aggregate, optimised=optimised, sets=None)
    return unwrap(alternatives_table)(analysis)  # without the check of its argument's type


def optima(names):
    claim = {"parameters": dict.fromkeys(names, 0.5), "location": ["at an end"]}
    sets = {name: np.full(1, 0.5) for name in names}
    people = People(["P1"], np.ones(1), {}, ("bad", "good"), {}, sets, None)
    return optima_table({"optimum": claim, "alternatives": {"ep": claim}}, people)


def compared(names):
    entry = {"optimum": dict.fromkeys(names, 0.5), "influence": {"P1": 0.1}}
    return comparison_table({"rules": {"bcm": entry, "pooled": {"refused": "too many"}}})


def simulated(study):
    trials = jax.tree.map(lambda leaf: leaf[None], Trials.from_arrays(np.array([ONE]), np.array([1])))
    truth = SimpleNamespace(truth=dict.fromkeys(study.space.names, 0.5))
    persons = SimpleNamespace(optimum=jnp.array([ONE]))
    return to_table(study, trials), unwrap(truth_table)(study, truth, persons)


def exported():
    tables = []
    for kind, table in (("optimisation", trials_table), ("validation", sets_table)):
        driver = Driver(kind)
        driver.header = msgspec.structs.replace(driver.header, unblinded="the tester")
        driver.state = type(driver.state).start(STUDY.file, driver.header)
        driver.step()
        driver.do("answer", 1)
        driver.finish()
        tables.append(table([driver.state]))
    return tables


def tables():
    """Each with its columns; of a study with the parameters u and v."""
    yield "alternatives", list(alternatives(STUDY))
    yield "optima", list(optima(STUDY.space.names))
    yield "comparison", list(compared(STUDY.space.names))
    grid, points = (map_dataset(study, surface, 3) for study in (STUDY, whole_numbers()))
    yield "map", [*grid.variables, *points.variables, *points.dims]
    for table in (*simulated(STUDY), *exported()):
        yield "answers and sets", list(table)


def whole_numbers():
    """Whose map is at points: one of two parameters has steps."""
    parameters = {"u": {"low": 0, "high": 3, "integer": True}, "v": {"low": 0.0, "high": 1.0}}
    return Study.from_dict(PLAIN | {"parameters": parameters})


def test_the_columns_of_every_table_are_reserved():
    for table, columns in tables():
        assert {"u", "v"} <= set(columns), table
        free = [name for name in columns if name not in ("u", "v") and not is_reserved(name, STUDY.responses, False)]
        assert not free, (table, free)


def test_the_columns_of_a_renderer_s_tables_are_reserved():
    study = Study.load("hilbo/data/paper.toml")
    x = np.array([0.3, 0.5, 0.4])
    sets = simulated_sets(study, Sets(jnp.array([x, x, x]), jnp.zeros(3), jnp.ones(3)), np.array([x]))
    for columns in (list(alternatives(study, x)), list(sets)):
        own = set(columns) - set(study.space.names)
        assert {"K0"} < own and all(is_reserved(name, study.responses, True) for name in own)


@pytest.mark.parametrize("name", ["optimum", "p_top", "passivity_margin", "method", "feasible", "noise", "P(close)"])
def test_a_parameter_of_such_a_name_is_refused(name):
    with pytest.raises(InputError, match=f"tables have a column {re.escape(name)} already"):
        called(name)


@pytest.mark.parametrize("name", ["T", "N", "memory", "K0"])
def test_what_a_renderer_is_told_is_reserved_beside_a_renderer_alone(name):
    with pytest.raises(InputError, match=f"tables have a column {name} already"):
        rendered(name)
    study = called(name)
    assert moved(study, jnp.array([0.5, 0.5]), jnp.array([0.25, 0.5]))["moved"][name] == {"by": 0.25, "percent": 25.0}
    assert dictionary({"optima": optima(study.space.names)}, study).set_index("column").at[name, "unit"] == ""


def test_a_parameter_called_f_keeps_its_values():
    """And the latent score has a column of its own, on the page too."""
    study = called("f")
    table = alternatives(study)
    assert table["f"].tolist() == [0.5] * 4 and table["mean"].iloc[0] == 0.75 and study.space.names == ("f", "v")
    assert alternatives_rows(study, table)["head"] == ["", "f", "v", "latent score", "sd"]
