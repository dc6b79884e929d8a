"""Hostile parameter sets, of short and of full memory, to the firmware's core; what comes into force is judged.

    python attacks/sets.py --count 40000 --seed 0 --state sets.json

The judge is no code of the device: it takes the set as GET_SET tells it and the exponentials as they were sent, and
computes in float64 the damping that Colgate and Schenkel's condition asks for, at 400 frequencies. Range, static
stiffness and name (CRC) have to be right too. Sets are random, at the edge of passivity, or of odd floats; exponentials
are those of alpha, a little wrong, of another alpha, swapped, missing, sent twice, or others with the same sums.
"""

import random
import struct
import sys
import zlib
from pathlib import Path
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[1]), str(Path(__file__).parents[1] / "tests" / "support")]

import jax.numpy as jnp
import numpy as np
from helpers_firmware import CONFIG, Device, pack, parameters

from attacks.support import main
from hilbo.mechanics.exponentials import exponentials
from hilbo.mechanics.span import STATES

__all__ = ["Sets"]

T = 1e-3  # s
DAMPING = CONFIG["damping"]  # N·s/m
LOOSE = 1e-4  # of the damping: what float32 may be off by
ODD = [
    struct.unpack("<f", struct.pack("<I", bits))[0] for bits in (0, 1, 0x80000000, 0x7F800000, 0x7FC00000, 0xFF7FFFFF)
]
Z = np.exp(1j * np.linspace(1e-3, np.pi, 400))


class Sets:
    """A device; `case` is one set."""

    def __init__(self):
        self.device, self._alphas = Device(), np.random.default_rng(0).uniform(0.02, 0.98, 40).astype(np.float32)
        self._states = {
            (float(alpha), count): [
                (float(p), float(loss)) for p, loss in np.column_stack(exponentials(jnp.asarray(alpha, float), count))
            ]
            for alpha in self._alphas
            for count in STATES
        }

    def __call__(self, rng: random.Random, number: int) -> str:
        """The word under which a set counts."""
        if number % 500 == 0:
            self.device.boot(7 + number)
            self.device.hello()
        self.device.tick()  # which ends the switch to the set before
        full = rng.random() < 0.6
        model = self._model(rng, full)
        how = rng.choice(_SPOILT) if full else ""
        rows = self._spoilt(rng, model, how) if full else []
        sent = self._send(rng, model, rows, how)
        crc = zlib.crc32(b"".join(sent))
        before = self.device.must("GET_SET", bank=0)
        self.device.beat()
        answer = self.device.ask("COMMIT", set_id=self._id, crc=crc, boot_id=self.device.boot_id)
        after = self.device.must("GET_SET", bank=0)
        kind = "full" if full else "short"
        if answer[0] != "ACK":
            changed = after["crc"] != before["crc"] or after["flags"] != before["flags"]
            return f"THROUGH: refused, and in force: {after}" if changed else f"{kind} memory, refused"
        why = judged(after, rows, crc)
        return f"THROUGH: {kind} {how}, {why}, {after} {rows}" if why else f"{kind} memory, in force"

    def _model(self, rng: random.Random, full: bool) -> dict[str, Any]:
        alpha, B1 = float(rng.choice(self._alphas)), 10 ** rng.uniform(-2, 1.5)
        N, beta = 2 * rng.randrange(0, 130) + rng.choice((1, 1, 1, 0)), B1 * T**-alpha
        K_eff, K1 = rng.uniform(-0.02, 1.9), 10 ** rng.uniform(-0.4, 1.6)
        if rng.random() < 0.5:  # to the edge of what the device's damping allows
            room = DAMPING * (1 + rng.choice((-1, 1)) * 10 ** rng.uniform(-6, -1)) / (500 * T) - K_eff
            K1 = room * beta * 2**alpha / (beta * 2**alpha - room) if beta * 2**alpha > room > 0 else K1
        K0 = K_eff if full else K_eff - _series(K1, beta * _taps(alpha, N).sum())
        model = {"K0": K0, "K1": K1, "B1": B1, "alpha": alpha, "N": N, "force_limit": rng.uniform(-1, 60)}
        if rng.random() < 0.2:
            model[rng.choice(("K0", "K1", "B1", "alpha", "force_limit"))] = rng.choice(ODD)
        model["force_limit"] = 30.0 if rng.random() < 0.7 else model["force_limit"]
        return {name: float(np.clip(v, -3e38, 3e38)) if v == v and name != "N" else v for name, v in model.items()}

    def _spoilt(self, rng: random.Random, model: dict[str, Any], how: str) -> list[tuple[float, float]]:
        count = rng.choice(STATES)
        alpha = model["alpha"] if (model["alpha"], count) in self._states else float(self._alphas[0])
        rows = list(self._states[alpha, count])
        at, other = rng.sample(range(count), 2)
        if how == "a little wrong":
            share = 1 + rng.choice((-1, 1)) * 10 ** rng.uniform(-8, -1)
            rows[at] = (rows[at][0] * share, rows[at][1]) if rng.random() < 0.5 else (rows[at][0], rows[at][1] * share)
        elif how == "of another alpha":
            rows = list(self._states[float(rng.choice(self._alphas)), count])
        elif how == "swapped":
            rows[at], rows[other] = rows[other], rows[at]
        elif how == "odd":
            rows[at] = (rng.choice(ODD), rows[at][1]) if rng.random() < 0.5 else (rows[at][0], rng.choice(ODD))
        elif how == "same sums":
            rows = _same_sums(rng, rows)
        return rows

    def _send(self, rng: random.Random, model: dict[str, Any], rows, how: str) -> list[bytes]:
        """The payloads that were sent; `_id` is the set's."""
        self._id = rng.randrange(1, 60_000)
        messages = [("SET_PARAMS", parameters(model | ({"states": rows} if rows else {}), self._id))]
        for first in range(0, len(rows), 7):
            part = rows[first : first + 7]
            messages.append(("SET_STATES", pack("SET_STATES", part, set_id=self._id, first=first, count=len(part))))
        if how == "missing":
            del messages[rng.randrange(1, len(messages))]
        elif how == "twice":
            messages.insert(rng.randrange(1, len(messages)), rng.choice(messages[1:]))
        for name, payload in messages:
            self.device.ask(name, payload)
        return [payload for _, payload in messages]


_WRONG = ("a little wrong", "of another alpha", "swapped", "odd", "missing", "twice", "same sums")
_SPOILT = ("", "", "", "a little wrong", *_WRONG)


def _same_sums(rng: random.Random, rows) -> list[tuple[float, float]]:
    """Other weights of the same losses, with the same two sums."""
    p, loss = np.array(rows).T
    three = rng.sample(range(len(rows)), 3)
    a, b, c = 2 / (2 - loss[three])
    step = np.array([b - c, c - a, a - b])  # no change of Σp, nor of Σp·2/(1 + λ)
    most = min((p[i] / -s for i, s in zip(three, step, strict=True) if s < 0), default=0.0)
    p[three] += rng.random() * most * step
    return [(float(weight), float(share)) for weight, share in zip(p, loss, strict=True)]


def _series(K1: Any, other: Any) -> Any:
    """Two stiffnesses in series."""
    return K1 * other / (K1 + other)


def _taps(alpha: float, N: int) -> np.ndarray:
    """The weights of N past samples."""
    number = np.arange(1, N)
    return np.cumprod(np.r_[1.0, (number - 1 - alpha) / number])


def judged(stated: dict[str, Any], rows, crc: int) -> str:
    """Why a set must not be in force; nothing if it may."""
    K0, K1, B1, alpha = (stated[name] for name in ("K0_N_per_mm", "K1_N_per_mm", "B1_N_s_alpha_per_mm", "alpha"))
    ranges = {"K0": K0, "K1": K1, "B1": B1, "alpha": alpha}
    outside = [
        n for n, v in ranges.items() if not np.float32(CONFIG[f"{n}_low"]) <= v <= np.float32(CONFIG[f"{n}_high"])
    ]
    if outside:
        return f"out of range: {outside}"
    if stated["crc"] != crc or not 0 <= stated["force_limit_N"] <= CONFIG["force_limit"]:
        return "name or force limit"
    beta = B1 * T**-alpha
    if rows:
        p, loss = np.array(rows, np.float32).astype(float).T
        memory, static = sum(w * (1 - 1 / Z) / (1 - (1 - r) / Z) for w, r in zip(p, loss, strict=True)), K0
    else:
        taps = _taps(alpha, stated["length"])
        memory = np.polynomial.polynomial.polyval(1 / Z, taps)
        static = K0 + _series(K1, beta * taps.sum())
    H = K0 + _series(K1, beta * memory)
    needs = np.max(500 * T / (1 - Z.real) * ((1 - 1 / Z) * H).real)
    if static < -1e-4 * abs(K0):
        return f"static stiffness {static}"
    return f"needs {needs} N·s/m" if needs > DAMPING * (1 + LOOSE) else ""


if __name__ == "__main__":
    main(Sets, __doc__.partition("\n")[0], 40_000)
