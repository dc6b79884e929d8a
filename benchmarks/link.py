"""A long conversation with the simulated device: telemetry of every tick, steady requests, sets changed in contact.

    python benchmarks/link.py [--minutes 10] [--write]

Counted are samples against the device's own ticks, frames lost in either direction, repeated requests, HOLDs and late
ticks. Round trips are times of this computer, which the device shares; nothing is asserted of them. --write puts the
table into docs/device/device.md.
"""

import argparse
import platform
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from pages import put

from hilbo.device import messages
from hilbo.hardware_bridge import Renderer

SETS = (
    {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176},
    {"K0": -2.89, "K1": 5.70, "B1": 5.89, "alpha": 0.203},
)
PAUSE = 0.02  # s between requests
CHANGE = 1.0  # s between sets


def converse(device, seconds):
    """Requests for so many seconds of the device's time; a row of counts."""
    device.send(**SETS[0])
    device.start()
    device.link.round_trips.clear()
    first = device.status().tick
    sent, trips, seen, changes = 0, [], 0, 0
    while (now := device.status().tick) - first < seconds / device.tick_s:
        device.echo(bytes([sent % 256]) * 32)
        sent += 2
        if (now - first) * device.tick_s > changes * CHANGE:
            device.send(**SETS[changes % 2])
            changes += 1
        seen += device.samples(0.0).tick.size
        trips += list(device.link.round_trips)
        device.link.round_trips.clear()
        time.sleep(PAUSE)
    return {"sent": len(trips), "changes": changes, "seen": seen, "trips": np.array(trips) * 1e3}


def measure(minutes):
    device = Renderer.open("sim", options={"finger": "all"})
    try:
        before = device.status().tick
        conversation = converse(device, 60 * minutes)
        status, counts = device.status(), device.counts()
        device.link.request(messages.Stream(divisor=0, fields=0))
        time.sleep(0.2)
        counts, link = device.counts(), device.link
        simulator, rate = device.simulator, device.device.tick_rate_Hz
        device.stop()
        words = simulator.close()
    finally:
        device.link.close()
        device.simulator.close()
    ticks = status.tick - before
    # Every tick is a sample, but for those before the stream was asked for, and the samples of an unfinished frame.
    assert abs(counts.samples + counts.dropped + counts.missing - ticks) < 200, (counts, ticks)
    assert (status.holds, status.estops) == (0, 0), status
    lost = status.frames_dropped + link.dropped
    trips = conversation["trips"]
    return [
        ("device time", f"{ticks / rate / 60:.1f} minutes, {ticks:,} ticks"),
        ("telemetry", f"every tick, {counts.samples:,} samples"),
        ("samples dropped by the device / missing", f"{counts.dropped} / {counts.missing}"),
        ("requests answered, sets changed in contact", f"{len(trips):,}, {conversation['changes']}"),
        ("frames damaged, either way", f"{lost}"),
        ("requests sent again, answers that fit none", f"{link.retries}, {link.stray}"),
        ("HOLDs, overruns reported by the device", f"{status.holds}, {status.overruns}"),
        ("round trip: median, 99 %, largest", " / ".join(f"{np.quantile(trips, q):.2f} ms" for q in (0.5, 0.99, 1))),
    ], words


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--write", action="store_true", help="put the table into docs/device/device.md")
    chosen = parser.parse_args()
    rows, words = measure(chosen.minutes)
    table = "| | |\n|---|---:|\n" + "".join(f"| {name} | {value} |\n" for name, value in rows)
    if words:
        table += f"\nThe simulated device's last line: {words.removeprefix('hilbo-device: ')}"
    table += f" Python {platform.python_version()}, {platform.system()}.\n"
    print(table)
    if chosen.write:
        put("device/device.md", "link", table)


if __name__ == "__main__":
    main()
