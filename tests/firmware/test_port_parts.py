"""Parts of the ports alone: the ring of the emulated board's line, and the clock of the host port."""

import ctypes
import signal
import subprocess
import sys
import time

import pytest
from helpers_firmware import FIRMWARE, STRICT, compiler

RING = """
#include "ring.h"
static struct ring ring;
void put(uint8_t byte) { ring_put(&ring, byte); }
int take(void) { uint8_t byte = 0; return ring_take(&ring, &byte) ? byte : -1; }
void wrap(void) { ring.put = ring.got = UINT32_MAX - 100U; }
"""
WAIT = """
import ctypes, sys
clock = ctypes.CDLL(sys.argv[1])
clock.clock_wait.restype = ctypes.c_int64
state = ctypes.create_string_buffer(64)
clock.clock_start(state, ctypes.c_int64(int(sys.argv[2])))
print("waits", flush=True)
print(*(clock.clock_wait(state) for _ in range(3)))
"""


def shared(folder, *sources, include):
    target = folder / "part.so"
    options = [*STRICT, "-Wno-missing-prototypes", "-D_XOPEN_SOURCE=700", "-shared", "-fPIC", f"-I{include}"]
    subprocess.run([compiler(), *options, *map(str, sources), "-o", str(target)], check=True)
    return target


@pytest.mark.parametrize("wraps", [False, True])
def test_a_ring_that_is_full_drops_what_comes_and_gives_nothing_twice(tmp_path, wraps):
    (tmp_path / "ring.c").write_text(RING)
    ring = ctypes.CDLL(str(shared(tmp_path, tmp_path / "ring.c", include=FIRMWARE / "port" / "arm")))
    if wraps:
        ring.wrap()
    for byte in range(700):
        ring.put(ctypes.c_uint8(byte % 251))
    taken = [ring.take() for _ in range(300)]
    assert taken == [byte % 251 for byte in range(256)] + [-1] * 44
    ring.put(7)
    assert [ring.take(), ring.take()] == [7, -1]


def test_a_wait_that_ends_between_one_and_two_periods_late_is_counted(tmp_path):
    """The process sleeps on past its deadline, as on a busy computer."""
    period = 0.2
    source = FIRMWARE / "port" / "host" / "clock.c"
    library = shared(tmp_path, source, include=source.parent)
    command = [sys.executable, "-c", WAIT, str(library), str(int(period * 1e9))]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stdout.readline() == "waits\n"
        time.sleep(period / 4)  # now it sleeps
        process.send_signal(signal.SIGSTOP)
        time.sleep(2.25 * period)
        process.send_signal(signal.SIGCONT)
        missed = [int(word) for word in process.stdout.readline().split()]
    assert missed[0] >= 1
