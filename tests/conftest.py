"""What every test runs under: float64, strict promotion, shapes checked at every call of what states some."""

import contextlib
import ctypes
import datetime
import gc
import itertools
import os
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # read once, by NumPy's and SciPy's import: as hilbo's commands run
os.environ.setdefault("MPLBACKEND", "Agg")
# Compiled functions are kept between runs, and shared by the workers of one run and by the processes that tests begin.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".pytest_cache" / "jax"))
os.environ |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0", "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1"}

import jax
import platformdirs
import pytest
from hypothesis import settings
from jaxtyping import install_import_hook

os.environ.setdefault("HILBO_KEEP_PROGRAMS", "0")  # else what an earlier run traced would be tested
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

PACKAGE = Path(__file__).parents[1] / "hilbo"


def modules_that_state_shapes() -> list[str]:
    """Of these modules every call is checked, in every run. A run without -m checks the others too; to do so always
    took half of the time of the tests of sessions, and Pyright judges their types."""
    files = [file for file in sorted(PACKAGE.rglob("*.py")) if "jaxtyping" in file.read_text()]
    return [".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts) for file in files]


CHECKER = "beartype.beartype"
install_import_hook(modules_that_state_shapes(), CHECKER)  # stays for the whole run: the tests import hilbo

from hilbo.numerics.compiling import compiler_options, set_flags  # noqa: E402

set_flags()  # as hilbo's commands are compiled

QUICKLY = "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"

# The same examples in every run; pytest --hypothesis-profile=search draws new ones.
settings.register_profile("fixed", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None, max_examples=500, print_blob=True)
settings.load_profile("fixed")

MANY_MAPPINGS = 30_000
MUCH_MEMORY = 4 * 2**30  # bytes
gc.set_threshold(200_000, 50, 1000)  # traces are many small objects: Python's own thresholds cost a sixth
REQUIRE_ALL = os.environ.get("HILBO_REQUIRE_ALL", "") not in ("", "0")


def pytest_configure(config):
    """The default run compiles in a third of the time: the same programs, of which LLVM optimises nothing. Runs with
    deep tests compile as users do, and so does a run whose XLA_FLAGS name an optimisation level."""
    flags = os.environ.get("XLA_FLAGS", "")
    quick = config.getoption("markexpr") == "not deep" and "xla_backend_optimization_level" not in flags
    if quick and compiler_options():
        os.environ["XLA_FLAGS"] = f"{flags} {QUICKLY}".strip()
    if not config.getoption("markexpr"):
        install_import_hook("hilbo", CHECKER)
    if not hasattr(config, "workerinput"):
        _date_arviz()


def pytest_collection_modifyitems(items):
    """What empties JAX's caches comes first, while little is in them: to let go of thousands of programs takes seconds,
    and whatever a worker runs afterwards is traced anew."""
    items.sort(key=lambda item: item.get_closest_marker("empties_caches") is None)


def _date_arviz():
    """Writes the file that ArviZ writes at its first import of a day: two workers that import it at once fail."""
    folder = Path(platformdirs.user_cache_dir("arviz", "arviz"))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "daily_warning").write_text(datetime.date.today().isoformat())


@pytest.fixture(scope="module", autouse=True)
def _bounded_memory():
    """Compiled functions are let go after a file that left many. Each is mapped into memory several times, and a
    process that passes the kernel's limit (vm.max_map_count, 65,530) ends by a segmentation fault while it compiles.
    Workers of the slow tests grew to 11 GB each, which left no room for the browsers and programs that tests begin."""
    yield
    maps = Path("/proc/self/maps")
    if not maps.exists():
        return
    resident = int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    if resident > MUCH_MEMORY or maps.read_bytes().count(b"\n") > MANY_MAPPINGS:
        jax.clear_caches()
        gc.unfreeze()
        gc.collect()
        with contextlib.suppress(OSError, AttributeError):  # of other C libraries than GNU's
            ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="module", autouse=True)
def _frozen_memory():
    """What earlier files left is not looked through by the collections that each session, and the end of the run, ask
    for: of a worker that has traced thousands of programs one takes seconds."""
    gc.freeze()


@pytest.fixture
def getkey():
    """A function that gives another random key at each call, the same ones in every run."""
    seeds = itertools.count()
    return lambda: jax.random.key(next(seeds))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    return _no_skip((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector):
    return _no_skip((yield))


def _no_skip(report):
    """Under HILBO_REQUIRE_ALL a skipped test, or a skipped file, has failed; an expected failure is none."""
    if REQUIRE_ALL and report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[-1] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome = "failed"
        report.longrepr = f"skipped, and HILBO_REQUIRE_ALL allows no skip: {reason}"
    return report
