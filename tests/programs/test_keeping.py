"""A kept program gives the same bits as a traced one, and another program wherever anything differs."""

import shutil
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hilbo
from hilbo.numerics.tracing import keep_with, program
from hilbo.programs import surroundings as around
from hilbo.programs.entries import Entries
from hilbo.programs.keeping import Programs

pytestmark = pytest.mark.empties_caches
TRACES = []


class Result(eqx.Module):
    value: jax.Array
    names: tuple = eqx.field(static=True)
    number: float
    none: None = None


@program
def doubled(x, power=1, names=("a",)):
    TRACES.append(x)
    return {"result": Result(2.0 * x**power, names, power), "weak": jnp.where(True, 1.0, 2.0)}


@program
def drawn(key, count=3):
    TRACES.append(key)
    return jax.random.split(key, count)


@program
def cached(x):
    TRACES.append(jax.config.jax_enable_compilation_cache)
    return x


@program
def shown(x):
    jax.debug.print("{}", x)
    return x


def twice(x):
    return 2.0 * x


@program
def wrong(x):
    raise ValueError("a mistake of its own")


@pytest.fixture
def package(tmp_path):
    """A small package's folder, whose digest stands for all code."""
    folder = tmp_path / "package"
    folder.mkdir()
    (folder / "module.py").write_text("a = 1\n")
    return folder


@pytest.fixture
def kept(tmp_path, package):
    """Sets a keeper anew, as another process would; returns whether the last calls were traced."""
    remarks = []
    entries = Entries(tmp_path / "programs", remarks.append)

    def another_process():
        TRACES.clear()
        jax.clear_caches()
        keep_with(Programs(entries, package))
        return entries

    yield another_process
    keep_with(None)
    jax.config.update("jax_default_matmul_precision", None)
    assert remarks == []


def traced(kept, *args, function=doubled, **kwargs):
    """Whether another process, which makes this call, traces it."""
    kept()
    function(*args, **kwargs)
    return len(TRACES) > 0


X = np.linspace(0.0, 1.0, 7)


def test_the_second_process_traces_nothing_and_gives_the_same(kept):
    plain = doubled(jnp.asarray(X), names=("b",))
    for expected in (True, False):
        kept()
        result = doubled(jnp.asarray(X), names=("b",))
        assert bool(TRACES) == expected
        assert jax.tree.structure(result) == jax.tree.structure(plain)
        for a, b in zip(jax.tree.leaves(result), jax.tree.leaves(plain), strict=True):
            np.testing.assert_array_equal(a, b)
            assert getattr(a, "dtype", None) == getattr(b, "dtype", None)
            assert getattr(a, "weak_type", False) == getattr(b, "weak_type", False)


@pytest.mark.parametrize("made", [True, False])
def test_a_program_that_was_prepared_with_some_arrays_is_of_all(kept, made):
    keeper = Programs(kept(), Path(__file__).parent)
    if not made:
        keeper(twice, (X,), {})
        keeper = Programs(kept(), Path(__file__).parent)
    of_arrays = keeper(twice, (X,), {})
    assert of_arrays is not None
    np.testing.assert_array_equal(of_arrays([X + 1.0]), 2.0 * (X + 1.0))


def test_random_keys_go_in_and_out(kept):
    expected = jax.random.key_data(drawn(jax.random.key(1)))
    for again in (False, True):
        kept()
        np.testing.assert_array_equal(jax.random.key_data(drawn(jax.random.key(1))), expected)
        assert bool(TRACES) != again


def test_another_call_is_another_program(kept):
    assert traced(kept, jnp.asarray(X))
    assert not traced(kept, jnp.asarray(2 * X))
    assert traced(kept, jnp.asarray(X[:3]))
    assert traced(kept, jnp.asarray(X, jnp.float32))
    assert traced(kept, jnp.asarray(X), power=2)
    assert traced(kept, jnp.asarray(X), power=2.0)
    assert traced(kept, jnp.asarray(X), power=True)
    assert traced(kept, jnp.asarray(X), 1, ("c",))
    assert traced(kept, X)


def a_line(package, _):
    (package / "module.py").write_text("a = 2\n")


def a_new_module(package, _):
    (package / "other.py").write_text("")


def a_renamed_module(package, _):
    (package / "module.py").rename(package / "moved.py")


def a_version(_, monkeypatch):
    monkeypatch.setattr(around, "version", lambda name: "9.9" if name == "jaxlib" else "1")


def python(_, monkeypatch):
    monkeypatch.setattr("platform.python_version", lambda: "3.99")


def the_processor(_, monkeypatch):
    monkeypatch.setattr(around, "_processor", lambda: "another one")


def a_flag(_, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")


def another_flag(_, monkeypatch):
    monkeypatch.setenv("JAX_SOMETHING", "1")


def a_setting(_, __):
    jax.config.update("jax_default_matmul_precision", "float32")


@pytest.mark.parametrize(
    "change",
    [a_line, a_new_module, a_renamed_module, a_version, python, the_processor, a_flag, another_flag, a_setting],
)
def test_what_a_program_depends_on_makes_another(kept, package, monkeypatch, change):
    assert traced(kept, jnp.asarray(X)) and not traced(kept, jnp.asarray(X))
    with monkeypatch.context() as changed:
        change(package, changed)
        assert traced(kept, jnp.asarray(X)) and not traced(kept, jnp.asarray(X))


def test_code_that_is_edited_while_it_runs_publishes_nothing(kept, package):
    entries = kept()
    (package / "module.py").write_text("a = 3\n")
    doubled(jnp.asarray(X))
    assert not entries.sizes()


def test_within_a_trace_it_is_a_part_of_that_program(kept):
    kept()
    gradient = jax.grad(lambda x: doubled(x)["result"].value.sum())(jnp.asarray(X))
    np.testing.assert_array_equal(gradient, np.full(7, 2.0))
    rows = jax.vmap(lambda x: doubled(x)["result"].value)(jnp.asarray(X))
    np.testing.assert_array_equal(rows, 2 * X)


def test_jaxs_own_cache_is_off_while_a_program_is_made(kept):
    kept()
    before = jax.config.jax_enable_compilation_cache
    cached(jnp.asarray(X))
    assert TRACES == [False]
    assert jax.config.jax_enable_compilation_cache == before


def test_what_cannot_be_written_or_told_runs_as_ever(kept, capfd):
    entries = kept()
    np.testing.assert_array_equal(shown(jnp.asarray(X)), X)
    jax.effects_barrier()
    assert "0.5" in capfd.readouterr().out
    np.testing.assert_array_equal(doubled(jnp.asarray(X), names=(lambda: 1,))["result"].value, 2 * X)
    assert not entries.sizes()


def test_a_mistake_of_a_program_is_its_own(kept):
    kept()
    with pytest.raises(ValueError, match="of its own"):
        wrong(jnp.asarray(X))


def test_a_damaged_entry_is_made_again(kept, tmp_path, package):
    entries = kept()
    doubled(jnp.asarray(X))
    (path,) = entries.sizes()
    path.write_bytes(path.read_bytes()[:-1])
    remarks = []
    keep_with(Programs(Entries(entries.folder, remarks.append), package))
    np.testing.assert_array_equal(doubled(jnp.asarray(X))["result"].value, 2 * X)
    assert "damaged" in remarks[0]
    assert not traced(kept, jnp.asarray(X))


def test_the_digest_is_of_every_python_file(tmp_path):
    copy = tmp_path / "hilbo"
    shutil.copytree(Path(hilbo.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    whole = around.code_digest(copy)
    assert whole == around.code_digest(Path(hilbo.__file__).parent)
    for path in ("__init__.py", "numerics/newton.py", "study/estimate/aggregate.py"):
        before = (copy / path).read_text(encoding="utf-8")
        (copy / path).write_text(before + "#", encoding="utf-8")
        assert around.code_digest(copy) != whole
        (copy / path).write_text(before, encoding="utf-8")
