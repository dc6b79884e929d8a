"""Faults that the default run must catch: each is put into a copy of the tree, and tests of that run must fail there.

python tests/support/seeded_faults.py            all of them, some minutes; exit code 1 if one is not caught
python tests/support/seeded_faults.py fsync      those whose name holds a word
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]


class Fault(NamedTuple):
    name: str
    file: str
    right: str
    """Stands once in the file."""
    wrong: str
    tests: str
    """Files or folders of the default run, of which one test at least must fail."""


FAULTS = (
    Fault(
        "sign in the likelihood's third derivative",
        "hilbo/numerics/truncated_normal.py",
        "- variance, y**2 - variance) - out.skew * shift",
        "- variance, y**2 - variance) + out.skew * shift",
        "tests/test_likelihoods.py",
    ),
    Fault(
        "factor in Laplace's evidence",
        "hilbo/laplace.py",
        "- 0.5 * gradient @ mode - 0.5 * log_determinant",
        "- gradient @ mode - 0.5 * log_determinant",
        "tests/test_laplace.py",
    ),
    Fault(
        "prior counted again for each participant",
        "hilbo/population/pointwise.py",
        "Sums(explained / (prior * remaining),",
        "Sums(1.0 / remaining,",
        "tests/population",
    ),
    Fault(
        "prior variance of a warm start",
        "hilbo/session/choose/warm_start.py",
        "variance + (1.0 - share) * prior",
        "variance + prior",
        "tests/session/test_look_ahead.py",
    ),
    Fault(
        "factor under the root of the largest passive K1",
        "hilbo/passivity.py",
        "half**2 + 4 * A * Y",
        "half**2 + 2 * A * Y",
        "tests/test_passivity.py",
    ),
    Fault(
        "cluster of the errors: renderings left out",
        "hilbo/statistics/cluster_robust.py",
        "cov_cluster_2groups(sandwich, *clusters)",
        "cov_cluster_2groups(sandwich, clusters[0], clusters[0])",
        "tests/statistics",
    ),
    Fault(
        "fsync of an answer is lost",
        "hilbo/session/log/event_log.py",
        "            os.fsync(self._file)\n        except",
        "        except",
        "tests/session/test_event_log.py",
    ),
    Fault(
        "an undone answer still counts",
        "hilbo/session/log/transitions.py",
        'state = _taken_out(state, trial, status="undone")',
        'state = _taken_out(state, trial, status="answered")',
        "tests/session",
    ),
    Fault(
        "orders of materials without their mirror images",
        "hilbo/session/plan/counterbalance.py",
        "np.concatenate([square, square[:, ::-1]])",
        "np.concatenate([square, square])",
        "tests/session/test_counterbalance.py",
    ),
    Fault(
        "half of the damaged frames are read",
        "hilbo/device/frames.py",
        "zlib.crc32(body[:-4]) != int",
        "zlib.crc32(body[:-4]) > int",
        "tests/device",
    ),
    Fault(
        "index in the renderer's history",
        "firmware/core/hb_renderer.c",
        "history_mm[renderer->oldest + length] =",
        "history_mm[renderer->oldest + length - 1U] =",
        "tests/firmware",
    ),
    Fault(
        "the device's watchdog never ends a silence",
        "firmware/core/hb_device.c",
        "device->heartbeat_age_ticks >= device->config->watchdog_ticks",
        "device->heartbeat_age_ticks > device->config->watchdog_ticks",
        "tests/firmware tests/device",
    ),
    Fault(
        "a program's renderings are shown before they are confirmed",
        "hilbo/session/log/actions.py",
        "and show not in pending.confirmed:",
        "and show not in pending.renderings:",
        "tests/session/test_confirmed.py",
    ),
    Fault(
        "a program's proposals count in place of what it confirmed",
        "hilbo/session/choose/choice.py",
        '(trial.presented["a"] for trial in answered)',
        '(trial.renderings["a"] for trial in answered)',
        "tests/session/test_confirmed.py",
    ),
    Fault(
        "a program's parameters change in contact",
        "hilbo/app/rigs/stimulus_rig.py",
        "while self._has_force and self.snapshot.contact:",
        "while self._has_force and not self.snapshot.contact and self.snapshot.lost:",
        "tests/app/test_stimulus.py",
    ),
    Fault(
        "a program that is not neutral in time is believed",
        "hilbo/app/rigs/stimulus_rig.py",
        'self._start_timer("neutral", program.neutral_within_s + _TRAVEL, words)',
        'self._cancel_timer("neutral")',
        "tests/app/test_stimulus.py",
    ),
)


def failing(fault: Fault, copy: Path) -> str:
    """The first test that the fault fails in a copy of the tree, or ""."""
    path = copy / fault.file
    text = path.read_text(encoding="utf-8")
    if text.count(fault.right) != 1:
        raise SystemExit(f"{fault.file}: '{fault.right}' stands there {text.count(fault.right)} times, not once.")
    path.write_text(text.replace(fault.right, fault.wrong), encoding="utf-8")
    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".pytest_cache" / "jax"))
    surroundings = os.environ | {"PYTHONPATH": str(copy), "JAX_COMPILATION_CACHE_DIR": cache}
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n2", "--dist", "worksteal", "-m", "not deep"]
    run = subprocess.run(
        [*command, *fault.tests.split()], cwd=copy, env=surroundings, capture_output=True, text=True, check=False
    )
    path.write_text(text, encoding="utf-8")
    failed = [line.removeprefix("FAILED ") for line in run.stdout.splitlines() if line.startswith("FAILED ")]
    if bool(failed) != bool(run.returncode):
        raise SystemExit(f"{fault.name}: the tests did not run.\n{run.stdout[-2000:]}{run.stderr[-2000:]}")
    return failed[0] if failed else ""


def main() -> int:
    chosen = [fault for fault in FAULTS if all(word in fault.name for word in sys.argv[1:])]
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "hilbo"
        kept = shutil.ignore_patterns(".git", ".venv", ".pytest_cache", "build", "demo-results", "__pycache__")
        shutil.copytree(ROOT, copy, ignore=kept)
        for fault in chosen:
            test = failing(fault, copy)
            missed += not test
            print(f"{'caught' if test else 'MISSED'}  {fault.name}: {test[:110]}", flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} faults caught")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
