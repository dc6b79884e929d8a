"""Faults put into the core on purpose, and the tests that must notice each of them.

    python firmware/tests/faults.py [NAME...]

Each fault replaces one piece of text, which must occur exactly once, in a copy of the core; the named test file then
runs on that copy and has to fail. Exit status 1 if a fault goes unnoticed.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

__all__ = ["FAULTS", "Fault", "is_noticed"]

ROOT = Path(__file__).parents[2]
CORE = ROOT / "firmware" / "core"


class Fault(NamedTuple):
    """What is broken, where, and which tests are to say so."""

    name: str
    file: str
    old: str
    new: str
    tests: str  # tests/firmware/test_*.py


FAULTS = [
    Fault("history written once", "hb_renderer.c",
          "renderer->history_mm[renderer->oldest + length] = renderer->y_mm;", "", "renderer"),
    Fault("skips while it remembers", "hb_renderer.c", " && renderer->quiet == renderer->set.length", "", "renderer"),
    Fault("taps in the wrong order", "hb_renderer.c", "renderer->tap[i] *",
          "renderer->tap[renderer->set.length - 1U - i] *", "renderer"),
    Fault("rounding of the last elongation dropped", "hb_renderer.c", "gone ? 0.0F : y_rest_mm;", "0.0F;", "renderer"),
    Fault("equilibrium at the position itself", "hb_renderer.c", "renderer->rest_share * x_mm;", "x_mm;", "switching"),
    Fault("slowest exponentials drop small changes", "hb_renderer.c", "rest = change - (next - mean);", "rest = 0.0F;",
          "renderer"),
    Fault("loss may grow", "hb_renderer.c", "loss <= slower", "loss <= 1.0F", "sets"),
    Fault("signs of C(-1) exchanged", "hb_passivity.c", "i % 2U == 1U", "i % 2U == 0U", "passivity"),
    Fault("damping too small by 0.2 %", "hb_passivity.c", "500.0F *", "499.0F *", "passivity"),
    Fault("damping not compared", "hb_staging.c", "!(renderer->minimum_damping_N_s_per_m <=",
          "!(0.0F * renderer->minimum_damping_N_s_per_m <=", "passivity"),
    Fault("power not rounded", "hb_math.c", "(mantissa + 64U) >> 7", "mantissa >> 7", "passivity"),
    Fault("one bit of the checksum ignored", "hb_frame.c", "if (crc != hb_crc32(0U, body, size))",
          "if ((crc | 1U) != (hb_crc32(0U, body, size) | 1U))", "protocol"),
    Fault("too long for ever", "hb_frame.c", "    receiver->overlong = false;\n", "", "protocol"),
    Fault("bytes after an overlong frame kept", "hb_frame.c", "    receiver->size = 0U;\n", "", "frames"),
    Fault("frames that end early taken for COBS", "hb_frame.c",
          "mark == size ? size - 1U : 0U", "size - 1U", "protocol"),
    Fault("big-endian", "hb_messages.c",
          "(uint8_t)(value & 255U));\n    return put_u8(payload, at, (uint8_t)(value >> 8));",
          "(uint8_t)(value >> 8));\n    return put_u8(payload, at, (uint8_t)(value & 255U));", "frames"),
    Fault("four bad positions", "hb_safety.h", "HB_LOSS_LIMIT 30U", "HB_LOSS_LIMIT 40U", "safety"),
    Fault("a stuck encoder is pushed on", "hb_device.c", "if (input_lost || (hb_is_in(device, HB_DRIVING) && "
          "hb_drive_is_stuck(&device->drive, device->config))) {", "if (input_lost) {", "safety"),
    Fault("friction taken for stuck", "hb_drive.c", " && ahead_mm >= 0.0F;", ";", "safety"),
    Fault("bad positions forgotten at once", "hb_safety.c", "(uint16_t)(safety->loss - 1U) : 0U;", "0U : 0U;",
          "contact"),
    Fault("a model is felt out of contact", "hb_device.c",
          "if (hb_in_contact(&device->safety)) {\n        force_N = run",
          "if (device->tick > 0U) {\n        force_N = run", "contact"),
    Fault("switch from the unsaturated force", "hb_device.c",
          "felt(device, (uint8_t)(1U - device->active), old_N) - felt_N", "old_N - felt_N", "contact"),
    Fault("the other set's limit", "hb_device.c", "felt(device, (uint8_t)(1U - device->active), old_N)",
          "felt(device, device->active, old_N)", "contact"),
    Fault("passivity controller without a bound", "hb_safety.c", "-force_N, most_N);",
          "-force_N, 1000.0F * most_N);", "contact"),
    Fault("the fade passes the old set's force", "hb_device.c",
          "hb_clamp(offset_N, 0.0F, gap_N) : hb_clamp(offset_N, gap_N, 0.0F);", "offset_N : offset_N;", "contact"),
    Fault("START on a bad encoder", "hb_safety.c", "safety->bad == 0U && !safety->lost;", "safety->bad < 99U;",
          "contact"),
    Fault("CLEAR before ESTOP has put out zero", "hb_motion.c", "device->safety.force_N != 0.0F) {", "false) {",
          "contact"),
    Fault("a gap counts as one tick", "hb_safety.c", "(float)(safety->bad + 1U);", "1.0F;", "safety"),
    Fault("HOLD never quite at zero", "hb_safety.c", "return safety->ramp_N * (", "return 1e-6F + safety->ramp_N * (",
          "safety"),
    Fault("twice the slew limit", "hb_safety.c", "safety->force_N - step_N, safety->force_N + step_N",
          "safety->force_N - 2.0F * step_N, safety->force_N + 2.0F * step_N", "safety"),
    Fault("the set's own force limit ignored", "hb_device.c",
          "set_limit_N < device->config->force_limit_N ? set_limit_N :", "", "safety"),
    Fault("watchdog one tick late", "hb_device.c", "heartbeat_age_ticks < config->watchdog_ticks", 
          "heartbeat_age_ticks < config->watchdog_ticks && device->tick % 250U != 7U", "safety"),
    Fault("late tick not looked at", "hb_device.c", "    if (late) {\n        return",
          "    if (late && !late) {\n        return", "safety"),
    Fault("difference of forces dropped at once", "hb_device.c", 
          "hb_towards_zero(device->offset_N, hb_clamp(step_N - along_N, 0.0F, step_N));", "0.0F;",
          "switching"),
    Fault("no difference taken", "hb_device.c", "device->offset_N = gap_N;", "device->offset_N = 0.0F;",
          "switching"),
    Fault("COMMIT before the history is warm", "hb_staging.c", "? device->warm_left : 0U;",
          "&& device->warm_left > 9U ? device->warm_left : 0U;", "switching"),
    Fault("staged history from nothing", "hb_staging.c",
          "hb_renderer_rest(idle, hb_penetration_mm(&device->safety, device->config));",
          "hb_renderer_rest(idle, 0.0F);", "switching"),
    Fault("old history out of contact", "hb_staging.c",
          "if (!hb_in_contact(&device->safety)) {\n        hb_renderer_rest",
          "if (device->tick == 0U) {\n        hb_renderer_rest", "switching"),
    Fault("a refused set stays staged", "hb_staging.c",
          "    device->staging = (uint8_t)HB_EMPTY;\n    enum hb_reason reason = check_numbers",
          "    enum hb_reason reason = check_numbers",
          "sets"),
    Fault("COMMIT by id alone", "hb_staging.c", " && confirmation->crc == device->crc[bank]", "", "sets"),
    Fault("an order for another start of the device", "hb_motion.c", "if (boot_id != device->boot_id) {",
          "if (false) {", "protocol"),
    Fault("an order from before the last stop", "hb_motion.c", "if (stop != device->stops) {", "if (false) {",
          "orders"),
    Fault("STOP at rest is not counted", "hb_motion.c",
          "    device->stops += 1U;\n    if (hb_is_in(device, HB_RUNNING) || hb_is_in(device, HB_DRIVING)) {",
          "    if (hb_is_in(device, HB_RUNNING) || hb_is_in(device, HB_DRIVING)) {\n        device->stops += 1U;",
          "orders"),
    Fault("START in contact", "hb_motion.c", "if (hb_in_contact(&device->safety)) {", "if (false) {", "safety"),
    Fault("START before it is homed", "hb_motion.c", "    if (!device->safety.homed) {", "    if (false) {", "safety"),
    Fault("an open stop can be cleared", "hb_motion.c", "if (device->stop_open) {", "if (false) {", "safety"),
    Fault("STOP ends ESTOP", "hb_motion.c", "if (hb_is_in(device, HB_RUNNING) || hb_is_in(device, HB_DRIVING))",
          "if (!hb_is_in(device, HB_STOPPED))", "protocol"),
    Fault("CLEAR during the ramp", "hb_motion.c", "hb_is_in(device, HB_HOLDING) && !hb_ramp_has_ended",
          "hb_is_in(device, HB_STOPPED) && !hb_ramp_has_ended", "safety"),
    Fault("the same seq is a repetition", "hb_requests.c", " && frame->crc == device->answered_crc", "", "protocol"),
    Fault("repetitions carried out", "hb_requests.c", "        device->answered = true;",
          "        device->answered = false;", "protocol"),
    Fault("anybody's heartbeat", "hb_requests.c", "if (pair.boot_id != device->boot_id) {", "if (false) {", "protocol"),
    Fault("a heartbeat is always fresh", "hb_requests.c", "uint32_t age = device->tick - pair.second;",
          "uint32_t age = 0U * pair.second;", "safety"),
    Fault("delay is not checked", "hb_delay.c", "config->delay_us > 0U ? HB_DELAY_ANGLES : 0U", "0U", "safety"),
    Fault("telemetry fills the buffer", "hb_line.c", "(2U * HB_MAX_FRAME)", "0U", "telemetry"),
]  # fmt: skip


def is_noticed(fault: Fault) -> bool:
    """Run the tests of a fault on a copy of the core that contains it; True if a test fails.

    Raises ValueError if the text to be replaced does not occur exactly once, or if the tests could not run.
    """
    with tempfile.TemporaryDirectory() as folder:
        core = Path(folder) / "core"
        shutil.copytree(CORE, core)
        source = core / fault.file
        text = source.read_text(encoding="utf-8")
        if text.count(fault.old) != 1:
            raise ValueError(
                f"{fault.name}: {fault.old!r} stands {text.count(fault.old)} times in {fault.file}, not once."
            )
        source.write_text(text.replace(fault.old, fault.new), encoding="utf-8")
        tests = ROOT / "tests" / "firmware" / f"test_{fault.tests}.py"
        environment = os.environ | {"HILBO_FIRMWARE_CORE": str(core), "HILBO_FIRMWARE_FLAGS": "-Wno-error"}
        options = ["-x", "-q", "-n", "0", "-m", "not deep", "-p", "no:cacheprovider"]
        command = [sys.executable, "-m", "pytest", *options, str(tests)]
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    if done.returncode not in (0, 1) or "-std=c11" in done.stdout:
        raise ValueError(f"{fault.name}: the tests did not run: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.returncode == 1


if __name__ == "__main__":
    chosen = [fault for fault in FAULTS if not sys.argv[1:] or fault.name in sys.argv[1:]]
    missed = 0
    for fault in chosen:
        noticed = is_noticed(fault)
        missed += not noticed
        print(f"{'noticed' if noticed else 'MISSED '}  {fault.name}", flush=True)
    sys.exit(1 if missed else 0)
