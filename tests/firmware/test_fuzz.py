"""The core under libFuzzer with AddressSanitizer and UndefinedBehaviorSanitizer; the harness knows the invariants."""

import os
import shutil
import subprocess
from pathlib import Path

import helpers_firmware as hf
import pytest

CORPUS = hf.FIRMWARE / "tests" / "corpus"
SECONDS = int(os.environ.get("HILBO_FUZZ_SECONDS", "60"))

pytestmark = pytest.mark.deep


def make(target: Path, core: Path) -> Path:
    """The fuzzer of this core; without clang or its runtime libraries the test is skipped."""
    if shutil.which("clang") is None:
        pytest.skip("there is no clang, which has libFuzzer (on Debian: clang libclang-rt-14-dev)")
    probe = ["clang", "-fsanitize=fuzzer,address,undefined", "-x", "c", "-", "-o", str(target)]
    text = "int LLVMFuzzerTestOneInput(const char *b, unsigned long n) { return b == 0 && n > 0; }"
    if subprocess.run(probe, input=text, text=True, capture_output=True, check=False).returncode != 0:
        pytest.skip("clang has no libFuzzer (on Debian: libclang-rt-14-dev)")
    command = ["make", "-C", hf.FIRMWARE, "fuzzer", f"BUILD={target.parent}", f"FUZZED={core}"]
    subprocess.run([*map(str, command)], check=True, capture_output=True)
    return target.parent / "fuzz" / "fuzz"


def run(fuzzer: Path, *arguments, folder: Path) -> subprocess.CompletedProcess:
    return subprocess.run([str(fuzzer), *map(str, arguments)], cwd=folder, capture_output=True, check=False)


@pytest.fixture(scope="module")
def fuzzer(tmp_path_factory):
    return make(tmp_path_factory.mktemp("fuzzer") / "probe", hf.CORE)


def test_nothing_breaks_the_device(fuzzer, tmp_path):
    inputs = tmp_path / "found"
    inputs.mkdir()
    # No limit on resident memory: a process inherits the peak of its parent, which is a test worker of gigabytes.
    limits = [f"-max_total_time={SECONDS}", "-max_len=600", "-rss_limit_mb=0", "-malloc_limit_mb=512"]
    done = run(fuzzer, *limits, inputs, CORPUS, folder=tmp_path)
    said = done.stderr.decode(errors="replace")
    broken = [path.read_bytes().hex() for path in tmp_path.glob("crash-*")]
    assert done.returncode == 0, f"{broken}\n{said[-4000:]}"
    print(said.splitlines()[-1])


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("hb_frame.c", "receiver->size < HB_MAX_ENCODED", "receiver->size <= HB_MAX_ENCODED"),
        ("hb_staging.c", "if (!names(confirmation, device, idle)) {", "if (false) {"),
        ("hb_staging.c", "device->active = idle;", "device->active = device->in_force ? device->active : idle;"),
        ("hb_safety.c", "return hb_clamp(force_N, -limit_N, limit_N);", "return force_N;"),
        ("hb_device.c", "hb_clamp(force_N, 0.0F, limit(device, bank)) : 0.0F;", "force_N : 0.0F;"),
        ("hb_device.c", "device->heartbeat_age_ticks += 1U;", ""),
        ("hb_motion.c", "return HB_NACK_NO_SET;", "(void)reply;"),
        ("hb_safety.c", "return safety->ramp_N * (", "return 1e-6F + safety->ramp_N * ("),
        ("hb_device.c", "hb_in_contact(&device->safety)) {\n        force_N", "true) {\n        force_N"),
        ("hb_device.c", "felt(device, (uint8_t)(1U - device->active), old_N) - felt_N", "old_N - felt_N"),
        ("hb_device.c", "        force_N = most_N;\n", ""),
        ("hb_motion.c", "device->safety.force_N != 0.0F) {", "false) {"),
        ("hb_safety.c", "safety->bad == 0U && !safety->lost;", "safety->bad < 99U;"),
    ],
    ids=[
        "receiver",
        "other set",
        "other bank",
        "drive limit",
        "set limit",
        "watchdog",
        "no set",
        "hold",
        "free air",
        "switch",
        "last place",
        "estop",
        "start",
    ],
)
def test_the_corpus_notices(tmp_path, file, old, new):
    core = tmp_path / "core"
    shutil.copytree(hf.CORE, core)
    text = (core / file).read_text(encoding="utf-8")
    assert text.count(old) == 1
    (core / file).write_text(text.replace(old, new), encoding="utf-8")
    done = run(make(tmp_path / "probe", core), "-runs=0", "-rss_limit_mb=0", CORPUS, folder=tmp_path)
    assert done.returncode != 0


def test_the_corpus_is_small():
    files = list(CORPUS.iterdir())
    assert 10 <= len(files) <= 80 and sum(path.stat().st_size for path in files) < 40_000
