"""Results of `hilbo passivity` for one parameter set on a device: numbers, and a verdict in words."""

import math
from typing import Any

from hilbo import passivity
from hilbo.viscoelastic import FOSLS

__all__ = ["passivity_result", "passivity_words"]


def passivity_result(model: FOSLS, b: float, delay: float = 0.0) -> dict[str, Any]:
    """The content of result.json of `hilbo passivity`: status, margin, binding frequency, largest K1, a witness.

    `b`: damping of the device, N·s/m. The status is valid for every delay of the force up to `delay` (s), as a device
    checks its sets and a study its space: the needed damping first falls with the delay and then rises, so that it is
    largest either without delay or at `delay`; `binding_delay` is that one. `margin`: lower and upper bound, N·s/m;
    `binding_frequency` in Hz; `largest_K1` in N/mm, None where every K1 is passive (`every_K1`) and for even N;
    `witness`: frequency (Hz) and energy (mJ) of a cycle, missing where none was constructed. Raises `InputError` for a
    delay out of range.
    """
    delays = (0.0, delay) if delay else (0.0,)
    certificate, binding = min(
        ((passivity.certify(model, b, delay=each), each) for each in delays), key=lambda pair: float(pair[0].lower)
    )
    status, K_eff, largest = certificate.status, float(certificate.static_stiffness), None
    if model.memory == "full" or model.N % 2 == 1:
        largest = min(passivity.largest_K1_beside(model, b, delay=each) for each in delays)
    content: dict[str, Any] = {
        "status": status,
        "margin": [float(certificate.lower), float(certificate.upper)],
        "minimum_damping": b - 0.5 * (float(certificate.lower) + float(certificate.upper)),
        "damping": b,
        "binding_frequency": float(certificate.frequency) / (2 * math.pi),
        "largest_K1": None if largest is None or math.isinf(largest) else largest,
        "every_K1": largest is not None and math.isinf(largest),
        "set": {name: float(getattr(model, name)) for name in ("K0", "K1", "B1", "alpha")},
        "K_eff": K_eff,
        "memory": model.memory,
        "N": model.N if model.memory == "short" else None,
        "T": model.T,
        "delay": delay,
        "binding_delay": binding,
    }
    if status == "violated" and (cycle := passivity.witness(model, b, delay=binding)) is not None:
        content["witness"] = {"frequency": cycle.frequency / (2 * math.pi), "energy_per_cycle": cycle.energy}
    return content


def passivity_words(content: dict[str, Any]) -> str:
    """The verdict in one to three sentences, from the content of `passivity_result`.

    A negative static stiffness gives one sentence.
    """
    K_eff, b = content["K_eff"], content["damping"]
    if K_eff < 0:
        return f"violated: the static stiffness H(1) = {K_eff:.4g} N/mm is negative, which no damping makes good."
    margin = content["margin"][0] if content["margin"][0] > 0 else content["margin"][1]
    late = f" at delays up to {1e6 * content['delay']:g} µs" if content["delay"] else ""
    at = f" at a delay of {1e6 * content['binding_delay']:g} µs" if content["delay"] else ""
    words = (
        f"{content['status']}{late}: the device has {b:g} N·s/m, {abs(margin):.4g} {'more' if margin > 0 else 'less'}"
        f" than the {content['minimum_damping']:.5g} N·s/m that the set needs;"
        f" {content['binding_frequency']:.4g} Hz{at} binds."
    )
    largest, cycle = content["largest_K1"], content.get("witness")
    if largest is not None:
        words += f" The largest passive K1 with this B1, α and K_eff = {K_eff:.4g} N/mm is {largest:.4g} N/mm."
    elif content["every_K1"]:
        words += " Every K1 is passive with this B1 and α."
    if cycle is not None:
        words += f" A cycle at {cycle['frequency']:.4g} Hz creates {-cycle['energy_per_cycle']:.3g} mJ."
    return words
