"""What the device's core costs on a Cortex-M: instructions per tick and message, code, state and stack.

    python benchmarks/firmware.py [--write]

Needs the cross compiler and the emulator (Debian: gcc-arm-none-eabi, libnewlib-arm-none-eabi, qemu-system-arm). The
counts are exact and the same on every machine with the same compiler: in the emulator an instruction takes a fixed
virtual time, and the processor's timer counts it. --write puts the tables into docs/device/firmware.md.
"""

import argparse
import re
import struct
import subprocess
import sys
import tempfile
from graphlib import TopologicalSorter
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from device_input import ENCODER_STEP, MACHINES, Recording, Section, emulate  # noqa: E402
from device_port import BUILD, FIRMWARE, image  # noqa: E402
from device_wire import Type  # noqa: E402

from hilbo.mechanics.exponentials import exponentials  # noqa: E402
from hilbo.viscoelastic import FOSLS  # noqa: E402

__all__ = ["MEMORIES", "measure", "sizes", "stack_of", "state_bytes"]

SET = (0.44, 1.40, 5.89, 0.203)  # K0, K1, B1, alpha: memory foam, so soft that all memories are passive with it
FLAGS = {"m4": "-mcpu=cortex-m4 -mfpu=fpv4-sp-d16", "m7": "-mcpu=cortex-m7 -mfpu=fpv5-d16"}
COMMON = "-mthumb -mfloat-abi=hard -std=c11 -O2 -ffp-contract=off -Icore"
MEMORIES = (("short memory, N = 25", 25, 0), ("short memory, N = 101", 101, 0), ("short memory, N = 255", 255, 0))
MEMORIES += tuple((f"{states} exponentials", 0, states) for states in (8, 10, 12))
TICKS = 3050
HELD = np.minimum(np.arange(1, TICKS + 1) / 50, 1)
PRESS = np.rint(5 / ENCODER_STEP * HELD).astype(int)  # 5 mm in 50 ms, held for 3 s


class Measured(NamedTuple):
    """Of one processor: sections, and each memory's largest errors in shares of its largest force."""

    sections: dict[str, Section]
    rounding: dict[str, float]
    memory: dict[str, float]
    stack: int  # bytes, with all that the measuring needs


def stage(recording: Recording, set_id: int, N: int, states: int) -> bytes:
    pairs = [np.asarray(part) for part in exponentials(jnp.asarray(SET[3]), states)] if states else None
    return recording.set(set_id, *SET, states=pairs, N=N or 101)


def begin(recording: Recording, N: int, states: int, name: str) -> bytes:
    """The section `name` has the frames of the set; then the set is in force and felt, out of contact."""
    recording.hello()
    recording.section(name)
    named = stage(recording, 1, N, states)
    recording.section("")
    recording.send(Type.COMMIT, named)
    recording.ticks([0] * 50)
    recording.send(Type.START, named + bytes(4))
    recording.ticks([0] * 50)
    return named


def memory_recording(name: str, N: int, states: int) -> bytes:
    recording = Recording()
    begin(recording, N, states, f"{'SET_PARAMS and SET_STATES' if states else 'SET_PARAMS'}, {name}")
    recording.section(name)
    recording.ticks(PRESS)
    return recording.done()


def scenes_recording() -> bytes:
    """Everything but the choice of memory, with N = 101."""
    recording = Recording()
    recording.section("stopped, no set")
    recording.ticks([0] * 60)
    begin(recording, 101, 0, "")
    recording.section("running, no contact")
    recording.ticks([0] * 200)
    recording.section("")
    recording.ticks(PRESS[:500])
    named = stage(recording, 2, 101, 0)
    recording.section("contact, another set of N = 101 staged")
    recording.ticks(PRESS[500:1000])
    recording.section("COMMIT")
    recording.send(Type.COMMIT, named)
    recording.section("contact, the tick of the swap")
    recording.ticks(PRESS[1000:1001])
    recording.section("")
    recording.ticks(PRESS[1001:1500])
    recording.section("HEARTBEAT")
    recording.send(Type.HEARTBEAT, struct.pack("<II", 1, recording.ticks_done))
    recording.section("GET_STATUS")
    recording.send(Type.GET_STATUS)
    recording.section("")
    recording.send(Type.STREAM, bytes([1, 1]))
    recording.section("contact, telemetry of every tick with sensed force")
    recording.ticks(PRESS[1500:2000])
    recording.section("")
    stage(recording, 3, 101, 0)
    recording.section("contact, both: a set staged and telemetry")
    recording.ticks(PRESS[2000:2200])
    recording.section("")
    recording.send(Type.ABORT)
    recording.send(Type.STREAM, bytes([0, 0]))
    recording.ticks(PRESS[49::-1])
    recording.section("no contact, but still remembered")
    recording.ticks([0] * 90)
    recording.section("")
    recording.ticks([0] * 4000)
    recording.section("no contact, forgotten")
    recording.ticks([0] * 90)
    return recording.done()


def measure(cpu: str, folder: Path) -> Measured:
    """Run everything on one processor."""
    _, _, sections, stack = emulate(scenes_recording(), folder, cpu)
    rounding, memory = {}, {}
    for name, N, states in MEMORIES:
        _, bits, costs, _ = emulate(memory_recording(name, N, states), folder, cpu)
        sections |= costs
        force = bits.view("<f4")[-TICKS:]
        x = ENCODER_STEP * PRESS
        kind = {"memory": "full", "states": states} if states else {"N": N}
        model, everything = (np.asarray(FOSLS(*SET, **how).simulate(x)) for how in (kind, {"N": TICKS}))
        rounding[name] = np.abs(force - model).max() / model.max()
        memory[name] = np.abs(force - everything).max() / everything.max()
    return Measured({name: cost for name, cost in sections.items() if name}, rounding, memory, stack)


def compile_core(cpu: str, folder: Path, *options: str) -> None:
    for source in sorted(FIRMWARE.glob("core/*.c")):
        target = folder / f"{source.stem}.o"
        command = ["arm-none-eabi-gcc", *FLAGS[cpu].split(), *COMMON.split(), *options, "-c", "-o", target, source]
        subprocess.run(command, cwd=FIRMWARE, check=True)


def sizes(cpu: str) -> tuple[int, int]:
    """Bytes of code and constants, and of variables, of the core alone."""
    objects = sorted((BUILD / cpu / "core").glob("*.o"))
    run = subprocess.run(["arm-none-eabi-size", *objects], capture_output=True, text=True, check=True)
    rows = np.array([line.split()[:3] for line in run.stdout.splitlines()[1:]], int)
    return int(rows[:, 0].sum()), int(rows[:, 1:].sum())


def state_bytes(cpu: str, folder: Path, *options: str) -> int:
    """sizeof(struct hb_device)."""
    (folder / "size.c").write_text('#include "hb_device.h"\nchar state[sizeof(struct hb_device)];\n')
    command = ["arm-none-eabi-gcc", *FLAGS[cpu].split(), *COMMON.split(), *options, "-c", "-o", folder / "size.o"]
    subprocess.run([*command, folder / "size.c"], cwd=FIRMWARE, check=True)
    run = subprocess.run(["arm-none-eabi-nm", "-S", folder / "size.o"], capture_output=True, text=True, check=True)
    return int(run.stdout.split()[1], 16)


def stack_of(cpu: str, folder: Path) -> dict[str, int]:
    """Largest stack (bytes) of each function and all that it calls. The core has no recursion and no callbacks."""
    compile_core(cpu, folder, "-fcallgraph-info=su")
    own, calls = {}, {}
    for file in folder.glob("*.ci"):
        text = file.read_text()
        for name, size in re.findall(r'node: \{ title: "([^"]+)" label: "[^"]*?(\d+) bytes', text):
            own[name] = int(size)
        for caller, callee in re.findall(r'edge: \{ sourcename: "([^"]+)" targetname: "([^"]+)"', text):
            calls.setdefault(caller, set()).add(callee)
    deepest = {}
    for name in TopologicalSorter({name: calls.get(name, set()) for name in own}).static_order():
        deepest[name] = own.get(name, 0) + max((deepest.get(callee, 0) for callee in calls.get(name, ())), default=0)
    return {name.split(":")[-1]: size for name, size in deepest.items()}


def tables(folder: Path) -> str:
    """The tables of docs/device/firmware.md."""
    by_cpu = {cpu: measure(cpu, folder) for cpu in MACHINES}
    version = subprocess.run(["arm-none-eabi-gcc", "--version"], capture_output=True, text=True).stdout.split("\n")[0]
    text = ["Made by `python benchmarks/firmware.py --write`.", ""]
    text += [f"Instructions, counted in the emulator (Cortex-M4F and M7, -O2, {version})."]
    text += ["", "| a tick (`hb_tick`) | M4 mean | M4 most | M7 mean | M7 most |", "|---|---:|---:|---:|---:|"]
    ticking = [name for name, cost in by_cpu["m4"].sections.items() if cost.ticks]
    for name in ticking:
        costs = [f"{cost.mean:,} | {cost.most:,}" for cost in (by_cpu[cpu].sections[name] for cpu in MACHINES)]
        label = f"contact, {name}" if name in by_cpu["m4"].memory else name
        text.append(f"| {label} | {' | '.join(costs)} |")
    text += ["", "| a message (`hb_receive` of its last byte and all before) | M4 | M7 |", "|---|---:|---:|"]
    for name in (name for name, cost in by_cpu["m4"].sections.items() if cost.frames and not cost.ticks):
        text.append(f"| {name} | {' | '.join(f'{by_cpu[cpu].sections[name].most_of_a_frame:,}' for cpu in MACHINES)} |")
    text += [
        "",
        f"Cost against error: 5 mm in 50 ms, held for 3 s; K0, K1, B1, α = {', '.join(map(str, SET))}. The device's",
    ]
    text += [
        "force against the same memory, and against all past samples, in float64; in shares of the largest force.",
        "",
    ]
    text += ["| memory | instructions a tick, M4 | error of rounding | and of memory |", "|---|---:|---:|---:|"]
    m4 = by_cpu["m4"]
    for name, *_ in MEMORIES:
        text.append(f"| {name} | {m4.sections[name].mean:,} | {m4.rounding[name]:.1e} | {m4.memory[name]:.1e} |")
    return "\n".join([*text, "", *memory_table(folder, by_cpu), ""])


def _of(name: str, stack: dict[str, int]) -> int:
    """Bytes of a function; the name of hb_init goes on with the maxima."""
    return next(size for function, size in stack.items() if function == name or function.startswith(f"{name}_2"))


def memory_table(folder: Path, by_cpu: dict[str, Measured]) -> list[str]:
    text = ["| bytes | M4 | M7 |", "|---|---:|---:|"]
    rows = {"code and constants of the core": [f"{sizes(cpu)[0]:,}" for cpu in MACHINES]}
    rows["variables of the core"] = [f"{sizes(cpu)[1]:,}" for cpu in MACHINES]
    for taps, states in ((255, 12), (101, 12), (1, 12)):
        options = f"-DHB_MAX_TAPS={taps}U", f"-DHB_MAX_STATES={states}U"
        label = f"state, `struct hb_device` (at most {taps} taps, {states} exponentials)"
        rows[label] = [f"{state_bytes(cpu, folder, *options):,}" for cpu in MACHINES]
    stacks = [stack_of(cpu, folder) for cpu in MACHINES]
    for name in ("hb_tick", "hb_receive", "hb_transmit", "hb_init"):
        rows[f"stack of `{name}`, at most (from the call graph)"] = [f"{_of(name, stack):,}" for stack in stacks]
    rows["stack of the measuring image, seen"] = [f"{by_cpu[cpu].stack:,}" for cpu in MACHINES]
    return text + [f"| {name} | {' | '.join(values)} |" for name, values in rows.items()]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="put the tables into docs/device/firmware.md")
    write = parser.parse_args().write
    jax.config.update("jax_enable_x64", True)
    for cpu in MACHINES:
        image("replay", cpu)
    with tempfile.TemporaryDirectory() as folder:
        text = tables(Path(folder))
    print(text, end="")
    if write:
        from pages import put  # beside this file: found when it is run, not when a test imports it

        put("device/firmware.md", "firmware", text)


if __name__ == "__main__":
    main()
