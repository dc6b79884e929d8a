"""Do the intervals of an identification hold the truth when the instrument is not perfect?

    python benchmarks/identification_coverage.py [--sets 40] [--cases white drift ...] [--write]
    python benchmarks/identification_coverage.py --source OLD --keep BEFORE [...]     with the hilbo in another checkout
    python benchmarks/identification_coverage.py --before BEFORE --write             both side by side

Every data set is the set S of the paper (N = 101, T = 1 ms) under the loads of `hilbo device characterise`: 5 mm held,
and 3 N, then 0.5 N, with ramps of 20 ms; depth and load differ by half a per cent from repeat to repeat. The force
channel has 20 mN of white noise, the position 2 µm. Nothing of this is hilbo's own: the material is the textbook
recursion, run at ten phases of the sampling time, so that lags and filters act on a grid ten times finer.
A 95 % interval *contains* the truth, an open end counting as endless, or it does not, or none is given. Data sets that
were done are kept, in a file for each case. --write puts the table into docs/methods/identification.md; all cases take
half an hour.
"""

import argparse
import json
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from scipy.signal import lfilter

ROOT = Path(__file__).parents[1]
TRUTH = (-2.89, 5.70, 5.89, 0.203)
BOUND = (0.44, 30.0, 2.5e-4, 0.35)  # its κ is beyond the search
FINE = 10  # phases of a sampling time
NOISE, JITTER = 0.020, 0.002  # N, mm
NAMES = ("K0", "K1", "B1", "alpha", "K_inst", "K_eff")


class Case:
    """How data sets of one kind are made."""

    def __init__(self, words, repeats=6, truth=TRUTH, only=None, step=1, rounded=False, **instrument):
        self.words, self.repeats, self.truth, self.only, self.step = words, repeats, truth, only, step
        self.rounded, self.lag, self.corner = rounded, instrument.get("lag", 0.0), instrument.get("corner")
        self.drift, self.common = instrument.get("drift", 0.0), instrument.get("common", False)


CASES = {
    "white": Case("white noise, 20 mN"),
    "white, one repeat": Case("the same, one repeat", repeats=1),
    "quantised": Case("rounded to 10 µm and 10 mN", rounded=True),
    "drift, one repeat": Case("random walk of 30 mN, one repeat", repeats=1, drift=0.03),
    "drift": Case("random walk of 30 mN in each of six repeats", drift=0.03),
    "drift, common": Case("one random walk of 30 mN in all six repeats", drift=0.03, common=True),
    "lag 0.1": Case("force late by 0.1 ms", lag=0.1),
    "lag 0.3": Case("force late by 0.3 ms", lag=0.3),
    "lag 0.7": Case("force late by 0.7 ms", lag=0.7),
    "lag -0.3": Case("position late by 0.3 ms", lag=-0.3),
    "filter": Case("first-order filter of the force, 200 Hz", corner=200.0),
    "coarse": Case("a row every 5 ms, ramps between rows", step=5),
    "bound": Case("creep only, κ beyond the search", truth=BOUND, only="creep"),
}


def taps(alpha, N=101):
    """Grünwald-Letnikov coefficients."""
    c = [1.0]
    for i in range(1, N + 1):
        c.append(c[-1] * (i - 1 - alpha) / i)
    return np.array(c)


def transfer(K0, K1, B1, alpha, T=1e-3):
    """Numerator and denominator of force over position."""
    c, stiff = taps(alpha), B1 * T**-alpha
    below = stiff * c
    below[0] += K1
    return K0 * below + K1 * stiff * c, below


def finely(put, above, below):
    """The recursion at each of the phases. (n FINE,) -> (n FINE,)."""
    out = np.empty_like(put)
    for phase in range(FINE):
        out[phase::FINE] = lfilter(above / below[0], below / below[0], put[phase::FINE])
    return out


def seen(force, case):
    """The force as its channel records it, finely: filtered exactly for straight lines, and late."""
    if case.corner is not None:
        a = 2e-3 * np.pi * case.corner / FINE  # a step over the time constant
        e = np.exp(-a)
        g = (1 - e) / a
        force = lfilter([1 - g, g - e], [1, -e], force)
    late = round(case.lag * FINE)
    return np.roll(force, late) if late <= 0 else np.concatenate([np.zeros(late), force[:-late]])


def records(case, number, hold):
    """Relaxation and creep of one data set: kind, time (s), positions (mm) and forces (N), (R, m) each."""
    rng = np.random.default_rng((2026, number))
    above, below = transfer(*case.truth)
    scale = 1 + 0.01 * (rng.permutation(case.repeats) + 0.5 - case.repeats / 2) / case.repeats
    for kind, seconds in (("relaxation", hold), ("creep", 2 * hold)):
        if case.only not in (None, kind):
            continue
        count = round(1e3 * seconds) + 1
        t = np.arange(count * FINE) / FINE - (rng.integers(case.step) if case.step > 1 else 0)  # ms from the load
        walk = None
        positions, forces = [], []
        for size in scale:
            if kind == "relaxation":
                x = size * 5 * np.clip(t / 20, 0, 1)
                F = finely(x, above, below)
            else:
                F = size * (3 * np.clip(t / 20, 0, 1) - 2.5 * np.clip((t - 1e3 * hold) / 20, 0, 1))
                x = finely(F, below, above)
            if walk is None or not case.common:
                walk = case.drift * np.cumsum(rng.standard_normal(count)) / np.sqrt(count)
            F = seen(F, case)[::FINE] + walk + NOISE * rng.standard_normal(count)
            x = x[::FINE] + JITTER * rng.standard_normal(count)
            positions.append(np.round(x / 0.01) * 0.01 if case.rounded else x)
            forces.append(np.round(F / 0.01) * 0.01 if case.rounded else F)
        rows = slice(None, None, case.step)
        yield kind, 1e-3 * np.arange(count)[rows], np.array(positions)[:, rows], np.array(forces)[:, rows]


def truth_of(case):
    """The parameters under their names, K_inst and K_eff by the definition of the transfer function."""
    above, below = transfer(*case.truth)
    return dict(zip(NAMES, (*case.truth, above[0] / below[0], above.sum() / below.sum()), strict=True))


def identified(case, number, hold):
    """What `characterise` says of one data set: the intervals, and the warnings."""
    from hilbo.identification.characterise import characterise
    from hilbo.identification.fitting import Test
    from hilbo.identification.sampled import Sampled

    tests = []
    for kind, t, x, F in records(case, number, hold):
        put, out = (x, F) if kind == "relaxation" else (F, x)
        tests.append(Test(kind, t, out, put))
    model = Sampled(lag="fit") if "lag" in Sampled.__annotations__ else Sampled()
    result = characterise(tests, model)
    intervals = {name: (e.value, e.lower, e.upper, e.status) for name, e in result.estimates.items()}
    return {"intervals": intervals, "warnings": list(result.warnings), "bootstrap": result.bootstrap}


def holds(interval, truth):
    """Whether an interval holds the truth; None where there is none."""
    _, low, high, status = interval
    if low is None and high is None:
        return None if status in ("not identifiable", "at bound") else False
    return bool((-np.inf if low is None else low) <= truth <= (np.inf if high is None else high))


def counted(done, case, name):
    """Intervals of a parameter that contain the truth, and those that are given."""
    truth = truth_of(case)[name]
    held = [holds(one["intervals"][name], truth) for one in done]
    return sum(h is True for h in held), sum(h is not None for h in held)


def safe(done, case):
    """Data sets whose intervals of the worst parameter contain the truth, or are not given, or that have a warning."""
    truth = truth_of(case)
    return min(
        sum(holds(one["intervals"][name], truth[name]) is not False or bool(one["warnings"]) for one in done)
        for name in NAMES
    )


def width(done, name):
    """Median width of the two-sided intervals."""
    ends = [one["intervals"][name][1:3] for one in done]
    widths = [high - low for low, high in ends if low is not None and high is not None]
    return np.median(widths) if widths else np.nan


def table(keep, before):
    """All cases that were run, before and after."""
    lines = [
        "| data | | K1 | B1 | α | K_inst | K_eff | warned | contained or warned | width of K1, K_inst |",
        "|---|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, case in CASES.items():
        runs = {when: (folder / f"{name}.json") for when, folder in (("before", before), ("now", keep)) if folder}
        runs = {when: json.loads(path.read_text()) for when, path in runs.items() if path.exists()}
        for when, done in runs.items():
            shares = ["{}/{}".format(*counted(done, case, p)) for p in ("K1", "B1", "alpha", "K_inst", "K_eff")]
            warned = sum(bool(one["warnings"]) for one in done)
            ratios = [width(done, p) / width(runs["before"], p) for p in ("K1", "K_inst")] if "before" in runs else []
            ratio = ", ".join("–" if np.isnan(r) else f"{r:.2f}" for r in ratios) if when == "now" else ""
            cells = [case.words, when, *shares, f"{warned}/{len(done)}", f"{safe(done, case)}/{len(done)}", ratio]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--sets", type=int, default=40)
    options.add_argument("--cases", nargs="+", choices=tuple(CASES), default=list(CASES))
    options.add_argument("--hold", type=float, default=3.0, help="s")
    options.add_argument("--source", type=Path, default=ROOT, help="checkout whose hilbo is used")
    options.add_argument("--keep", type=Path, default=ROOT / "identification-coverage")
    options.add_argument("--before", type=Path, help="folder of an earlier version's data sets, to compare with")
    options.add_argument("--write", action="store_true", help="only write the table of what was run")
    chosen = options.parse_args()
    if chosen.write:
        from pages import put

        return put("methods/identification.md", "instrument", table(chosen.keep, chosen.before))
    sys.path.insert(0, str(chosen.source))
    import jax

    jax.config.update("jax_enable_x64", True)
    import hilbo

    assert Path(hilbo.__file__).parents[1] == chosen.source.resolve(), hilbo.__file__
    chosen.keep.mkdir(parents=True, exist_ok=True)
    for name in chosen.cases:
        path, begin = chosen.keep / f"{name}.json", time.perf_counter()
        done = json.loads(path.read_text()) if path.exists() else []
        for number in range(len(done), chosen.sets):
            done.append(identified(CASES[name], number, chosen.hold))
        path.write_text(json.dumps(done))
        words = {p: "{}/{}".format(*counted(done, CASES[name], p)) for p in NAMES}
        named = sum(bool(d["warnings"]) for d in done)
        print(f"{name}: {words} warned {named}/{len(done)}, {time.perf_counter() - begin:.0f} s", flush=True)


if __name__ == "__main__":
    main()
