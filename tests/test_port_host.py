"""The host port: the C core with a simulated finger behind a pseudo-terminal, in raw bytes and in device ticks."""

import os
import signal
import struct
import subprocess
import sys
import zlib

import numpy as np
import pytest
from device_port import FIRMWARE, PATIENCE, SCHEMA, Port, State, compilers, program
from device_wire import Type, decode, encode, set_crc, set_params

WATCHDOG, HOLD_RAMP = 250, 20  # ticks


@pytest.mark.parametrize("compiler", compilers())
def test_a_conversation(compiler):
    with Port("--boot-id", "77", "--finger", "hold", compiler=compiler) as port:
        version, rate, schema, _, boot_id, line, damping = struct.unpack_from("<HHIIIIf", port.hello().payload)
        assert (version, rate, schema, boot_id, line) == (1, 1000, SCHEMA, 77, 921600)
        assert damping == np.float32(0.95)
        port.run()
        force = port.live(1500)
        status = port.status()
        assert status.state == State.RUNNING and status.contact == 1
        assert status.force_N == np.float32(force) > 0.5
        assert (status.holds, status.input_held, status.overruns, status.frames_dropped) == (0, 0, 0, 0)
        port.expect_ack(Type.STOP)
        assert port.tick(HOLD_RAMP) == 0
        assert port.status().state == State.STOPPED
