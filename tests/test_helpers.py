"""The test tools fail when they should."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from helpers import assert_traces_once, check_grad


@jax.custom_jvp
def wrong_slope(x):
    return x**2


wrong_slope.defjvp(lambda primals, tangents: (primals[0] ** 2, 2.00001 * primals[0] * tangents[0]))


def test_check_grad_accepts_right_derivatives_of_arrays_large_and_small():
    check_grad(lambda x, y: y * x**3, [1e-3, 2e-3], 1e6, rtol=1e-9)
    check_grad(lambda x: jnp.outer(x, x), [0.3, -2.0, 0.0], rtol=1e-9)


def test_check_grad_refuses_a_slope_that_is_5e_6_off():
    with pytest.raises(AssertionError, match="jacfwd, argument 0"):
        check_grad(wrong_slope, 3.0)


def test_check_grad_refuses_float32():
    with pytest.raises(AssertionError, match="need float64, not float32"):
        check_grad(jnp.sin, jnp.float32(1))


@pytest.mark.empties_caches
def test_traces_are_counted():
    double = jax.jit(lambda x: 2 * x)
    three, four = jnp.ones(3), jnp.ones(4)
    with assert_traces_once(double):
        double(three)
        double(three)
    with pytest.raises(AssertionError, match="traced 2 times"), assert_traces_once(double):
        [double(x) for x in (three, four)]
    with pytest.raises(AssertionError, match="traced 0 times"), assert_traces_once(double):
        pass


@pytest.mark.deep  # a run of pytest each; it is deep runs that allow no skip
@pytest.mark.parametrize(
    ("value", "outcome"), [("", "1 passed, 2 skipped, 1 xfailed"), ("1", "1 failed, 1 passed, 1 xfailed, 1 error")]
)
def test_a_skip_is_a_failure_when_everything_is_required(tmp_path, value, outcome):
    root = Path(__file__).parents[1]
    (tmp_path / "test_file.py").write_text("import pytest\npytest.importorskip('no_such_module')\n")
    (tmp_path / "test_case.py").write_text(
        "import pytest\n"
        "def test_runs(): pass\n"
        "def test_skips(): pytest.skip('no tool')\n"
        "@pytest.mark.xfail\n"
        "def test_fails(): assert False\n"
    )
    options = ["-p", "conftest", "-p", "no:cacheprovider", "--continue-on-collection-errors", "--rootdir", tmp_path]
    environment = os.environ | {"HILBO_REQUIRE_ALL": value, "PYTHONPATH": str(root / "tests")}
    run = subprocess.run(
        [sys.executable, "-m", "pytest", *options, tmp_path], capture_output=True, text=True, env=environment
    )
    assert outcome in run.stdout, run.stdout + run.stderr
    assert run.returncode == (1 if value else 0)
