"""The core in programs of others: C++ (Arduino, PlatformIO, SimpleFOC), and compilers that fuse multiply-adds."""

import functools
import platform
import shutil
import subprocess
from pathlib import Path

import pytest
from helpers_firmware import CORE, FIRMWARE

SKETCH = FIRMWARE / "tests" / "cplusplus.cpp"
STRICT_CPLUSPLUS = ["-std=c++17", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
ORDINARY = ("-std=c11", "-O2", "-ffp-contract=off")
FUSING = ("-std=c11", "-O2", "-ffp-contract=fast", "-mfma")
FUSING_ARDUINO = ("-std=gnu11", "-O2", "-mfma")
HEADERS = sorted(CORE.glob("*.h"))


def run(*command) -> None:
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@functools.cache
def sketch_object(folder: Path) -> Path:
    if shutil.which("g++") is None or shutil.which("gcc") is None:
        pytest.skip("the sketch needs gcc and g++ (Debian: gcc, g++)")
    target = folder / "sketch.o"
    run("g++", *STRICT_CPLUSPLUS, f"-I{CORE}", "-c", SKETCH, "-o", target)
    return target


def sketch(folder: Path, flags: tuple[str, ...]) -> subprocess.CompletedProcess:
    """What the C++ program prints with a core that gcc compiled with these flags."""
    program = sketch_object(folder)
    for source in sorted(CORE.glob("*.c")):
        run("gcc", *flags, f"-I{CORE}", "-c", source, "-o", folder / f"{source.stem}.o")
    objects = [folder / f"{source.stem}.o" for source in sorted(CORE.glob("*.c"))]
    run("g++", program, *objects, "-o", folder / "sketch", "-lm")
    return subprocess.run([folder / "sketch"], capture_output=True, text=True)


@pytest.mark.deep
def test_a_sketch_in_cplusplus_runs_with_the_core(tmp_path):
    done = sketch(tmp_path, ORDINARY)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.deep
@pytest.mark.parametrize("flags", [FUSING, FUSING_ARDUINO])
def test_a_core_that_fuses_products_and_sums_is_refused(flags, tmp_path):
    if platform.machine() not in ("x86_64", "AMD64") or "fma" not in Path("/proc/cpuinfo").read_text():
        pytest.skip("-mfma needs an x86-64 processor with FMA")
    done = sketch(tmp_path, flags)
    assert done.returncode == 1 and "-ffp-contract=off" in done.stdout


def test_every_header_has_linkage_for_cplusplus():
    for header in HEADERS:
        text = header.read_text(encoding="utf-8")
        opened, closed = text.find('extern "C" {'), text.rfind("#ifdef __cplusplus\n}\n#endif")
        assert 0 < text.rfind("#include") < opened < closed, header.name


def test_every_header_is_cplusplus_without_warnings():
    if shutil.which("g++") is None:
        pytest.skip("this test needs g++ (Debian: g++)")
    includes = "".join(f'#include "{header.name}"\n' for header in HEADERS)
    command = ["g++", *STRICT_CPLUSPLUS, "-fsyntax-only", f"-I{CORE}", "-x", "c++", "-"]
    done = subprocess.run(command, input=includes, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
