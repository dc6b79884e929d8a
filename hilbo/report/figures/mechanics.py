"""Figures of the mechanics: tests and fits, the price of short memory, passivity, the passive set, frequency response.

Like `maps`: a figure is a function from results to a matplotlib `Figure`, with axes in physical units.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from hilbo import passivity
from hilbo.identification.characterise import Characterisation
from hilbo.identification.fitting import Fit, Test
from hilbo.identification.memory_selection import LIMIT, Row
from hilbo.report.figures.style import BLUE, COLOURS, GREEN, GREY, ORANGE, RED, TWO_COLUMNS, new_figure, plain, styled
from hilbo.viscoelastic import FOSLS

__all__ = ["bode_figure", "curves_figure", "memory_figure", "passive_set_figure", "passivity_figure", "predicted"]

_LABELS = {
    "relaxation": ("time (s)", "force (N)"),
    "creep": ("time (s)", "position (mm)"),
    "modulus": ("time (s)", "relaxation modulus ({})"),
    "compliance": ("time (s)", "creep compliance (1/{})"),
}
_OTHERS = (2, 25, 201, None)  # memories that are compared with the fit's
_LINES = ((ORANGE, "-."), (GREEN, "--"), (RED, ":"), ("#CC79A7", "--"), ("black", ":"), ("#56B4E9", "-."))


def predicted(fitted: Fit, kind: str) -> np.ndarray:
    """Curve of a fit for one kind of test, at the times of that test, (m,). Raises `ValueError` for a kind that was not
    fitted.
    """
    place = [c.kind for c in fitted.curves].index(kind)
    return np.asarray(fitted.model.predict(fitted.q, fitted.curves[place], fitted.weights[place]))


@styled
def curves_figure(tests: Sequence[Test], result: Characterisation, unit: str = "N/mm") -> Figure:
    """For each test, above: mean and ± sd of the repeats, the fit, and fits with other memories; below: their
    residuals.

    `unit`: of moduli.
    """
    others = [row for row in result.rows if row.N in _OTHERS and getattr(result.fit.model, "N", None) != row.N]
    lines = [
        (row.fit, colour, dash, 0.9, "full memory" if row.N is None else f"N = {row.N}")
        for row, (colour, dash) in zip(others, _LINES, strict=False)
    ]
    lines.append((result.fit, BLUE, "-", 1.4, _fit_name(result.fit)))
    figure, panels = new_figure(
        3.7 * max(len(tests), 1.35), 4.8, 2, len(tests), sharex="col", squeeze=False, height_ratios=(3, 2)
    )
    for (upper, lower), test in zip(panels.T, tests, strict=True):
        _measured(upper, test)
        lower.axhline(0, color=GREY, linewidth=0.6)
        for fit, colour, dash, width, name in lines:
            curve = predicted(fit, test.kind)
            upper.plot(test.time, curve, color=colour, linestyle=dash, linewidth=width, label=name)
            left = test.output.mean(axis=0) - curve
            lower.plot(test.time, left, color=colour, linestyle=dash, linewidth=0.6 * width)
        if test.input is None:
            upper.set(xscale="log", yscale="log")
        elif test.kind == "relaxation":
            upper.set(xscale="log", xlim=(test.time[1], test.time[-1]))
        upper.set(title=test.kind, ylabel=_LABELS[test.kind][1].format(plain(unit)))
        lower.set(xlabel="time (s)", ylabel="measured - fit")
    figure.legend(*upper.get_legend_handles_labels(), loc="outside upper center", ncols=3, frameon=False)
    return figure


def _measured(axes, test):
    """Draw the mean of a test's repeats on `axes`, with a band of ± sd if there are several."""
    mean = test.output.mean(axis=0)
    if test.repeats > 1:
        sd = test.output.std(axis=0, ddof=1)
        label = f"measured, mean ± sd of {test.repeats}"
        axes.fill_between(test.time, mean - sd, mean + sd, color=GREY, alpha=0.3, linewidth=0, label=label)
        axes.plot(test.time, mean, color=GREY, linewidth=0.8)
    else:
        axes.plot(test.time, mean, ".", color=GREY, markersize=2, label="measured")


def _fit_name(fit):
    """Legend text of a fit: "fit" with its memory, "full memory" or "N = ...", if the model has one."""
    model = fit.model
    if getattr(model, "memory", None) == "short":
        return f"fit, N = {int(model.N)}"
    return "fit, full memory" if hasattr(model, "memory") else "fit"


@styled
def memory_figure(rows: Sequence[Row]) -> Figure:
    """NRMSE of the best fit against the number of taps, for relaxation and creep; full memory as a level line."""
    figure, axes = new_figure(6.0, 2.9)
    taps = [(row.N, row.nrmse) for row in rows if row.N is not None]
    for (kind, colour), marker in zip((("relaxation", BLUE), ("creep", ORANGE)), "os", strict=True):
        if kind not in rows[0].nrmse:
            continue
        percent = [100 * errors[kind] for _, errors in taps]
        axes.plot([N for N, _ in taps], percent, marker=marker, color=colour, label=kind)
        for row in rows:
            if row.N is None:
                axes.axhline(100 * row.nrmse[kind], color=colour, linestyle=":", label=f"{kind}, full memory")
    axes.axhline(100 * LIMIT, color=GREY, linewidth=0.8, linestyle="--", label=f"{100 * LIMIT:g} %")
    axes.set(xscale="log", yscale="log", xlabel="past samples N", ylabel="NRMSE of the best fit (%)")
    axes.set_xticks([N for N, _ in taps], [str(N) for N, _ in taps])
    low, high = axes.get_ylim()
    ticks = [t for t in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50) if low <= t <= high]
    axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _needed(model: FOSLS, delay: float):
    """Frequencies (Hz), and a complex curve (N·s/m) whose real part is the damping needed at each, with the force
    `delay` (s) late.
    """
    omega = np.geomspace(2 * np.pi * 0.5, np.pi / model.T, 600)
    response = np.asarray(model.frequency_response(jnp.asarray(omega)))
    cotangent = np.tan((np.pi - omega * model.T) / 2)
    curve = 500 * model.T * (1 + 1j * cotangent) * response
    if delay:
        curve = np.asarray(passivity.needed_damping(model, omega, delay=delay)) + 1j * curve.imag
    return omega / (2 * np.pi), curve


@styled
def passivity_figure(model: FOSLS, b: float, delay: float = 0.0) -> Figure:
    """Left: the curve (T/2)(1 + j cot(ωT/2))·H in the complex plane, which must stay left of `b` (N·s/m). Right: its
    real part, the damping needed, over frequency.

    With a `delay` (s) the real part is the damping needed with that delay.
    """
    frequency, curve = _needed(model, delay)
    worst = int(np.argmax(curve.real))
    margin, most = b - curve.real[worst], max(b, curve.real[worst])
    colour, word = (GREEN, "margin") if margin >= 0 else (ORANGE, "lacking")
    lowest = min(-2 * most, curve.real[worst] - most)
    near = curve.real > lowest  # far to the left, in slow motion, nothing is decided
    frequency, near_curve = frequency[near], curve[near]
    figure, (left, right) = new_figure(TWO_COLUMNS, 3.0, 1, 2)
    left.plot(near_curve.real, near_curve.imag, color=BLUE)
    left.plot(curve.real[worst], curve.imag[worst], "o", color=colour, markersize=5, clip_on=False)
    left.axvline(b, color="black", linewidth=1)
    left.axvspan(b, 1.5 * most, color=GREY, alpha=0.2, linewidth=0)
    left.set(xlim=(lowest, 1.5 * most), ylim=(0, None))
    left.set(xlabel="real part: damping needed (N·s/m)", ylabel="imaginary part (N·s/m)")
    left.set_title("passive if the curve stays left of the device's b")
    right.semilogx(frequency, near_curve.real, color=BLUE, label="needed by the rendering")
    right.axhline(b, color="black", linewidth=1, label=f"device, b = {b:.4g} N·s/m")
    binding_frequency = frequency[int(np.argmax(near_curve.real))]
    right.plot([binding_frequency, binding_frequency], [b, curve.real[worst]], color=colour, linewidth=2.5)
    right.plot(binding_frequency, curve.real[worst], "o", color=colour, markersize=5, clip_on=False)
    right.set(xlabel="frequency (Hz)", ylabel="damping (N·s/m)", ylim=(lowest, 1.5 * most))
    right.set_title(f"{word} {abs(margin):.3f} N·s/m at {binding_frequency:.0f} Hz")
    right.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    right.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    right.xaxis.set_minor_formatter(NullFormatter())
    right.legend(frameon=False, loc="lower right")
    return figure


@styled
def passive_set_figure(model: FOSLS, b: float, K_eff: float, delay: float = 0.0) -> Figure:
    """Left: largest passive K1 over B1 and α in the paper's box; right: the same over B1 at four values of α.

    `b`: device's damping, N·s/m; `K_eff`: static stiffness, N/mm; `delay`: of the force, s. For odd N and full memory.
    """
    B1, alpha = np.geomspace(0.1, 32, 121), np.linspace(0.01, 0.99, 121)
    limit = np.asarray(_largest(model, B1[None, :], alpha[:, None], b, K_eff, delay))
    this_set = float(model.B1), float(model.alpha), float(model.K1)
    figure, (left, right) = new_figure(TWO_COLUMNS, 3.0, 1, 2)
    shown = np.clip(limit, 1, 32)
    picture = left.pcolormesh(
        B1, alpha, np.where(limit < 1, np.nan, shown), cmap=COLOURS, vmin=1, vmax=32, rasterized=True
    )
    figure.colorbar(picture, ax=left, label="largest passive $K_1$ (N/mm; 32: the box)")
    left.plot(this_set[0], this_set[1], "*", color=RED, markersize=12, markeredgecolor="white")
    left.set(xscale="log", xlabel="$B_1$ (N·s$^α$/mm)", ylabel="α", xlim=(0.1, 32))
    left.set_title("white: no $K_1$ from 1 N/mm up is passive")
    for order, (colour, dash) in zip(
        (0.1, this_set[1], 0.35, 0.6), ((ORANGE, "--"), (BLUE, "-"), (GREEN, "-."), (GREY, ":")), strict=True
    ):
        line = np.asarray(_largest(model, B1, np.full_like(B1, order), b, K_eff, delay))
        width = 2.0 if order == this_set[1] else 1.2
        right.plot(B1, np.minimum(line, 64), color=colour, linestyle=dash, linewidth=width, label=f"α = {order:.3g}")
    right.plot(this_set[0], this_set[2], "*", color=RED, markersize=12, markeredgecolor="white", label="this set")
    right.set(xscale="log", xlabel="$B_1$ (N·s$^α$/mm)", ylabel="$K_1$ (N/mm)", xlim=(0.1, 32), ylim=(0, 32))
    right.set_title(f"passive below the line; b = {b:g} N·s/m")
    right.legend(frameon=False)
    for axes in (left, right):
        axes.xaxis.set_major_formatter(FormatStrFormatter("%g"))
    return figure


def _largest(model, B1, alpha, b, K_eff, delay):
    """`passivity.largest_K1` (N/mm) with the memory and T of a model; `B1` and `alpha` broadcast."""
    return passivity.largest_K1(B1, alpha, b, K_eff, model.N, model.T, memory=model.memory, delay=delay)


@styled
def bode_figure(model: FOSLS) -> Figure:
    """Magnitude and phase of the rendering, and of the continuous model with the same parameters, over frequency."""
    omega = np.geomspace(2 * np.pi * 0.05, np.pi / model.T, 400)
    frequency = omega / (2 * np.pi)
    memory = "full memory" if model.memory == "full" else f"N = {model.N}"
    both = {
        f"rendered, {memory}": (model.frequency_response, BLUE, "-"),
        "continuous, same parameters": (model.continuous_response, ORANGE, "--"),
    }
    figure, (upper, lower) = new_figure(4.6, 4.0, 2, 1, sharex=True)
    for name, (function, colour, dash) in both.items():
        response = np.asarray(function(jnp.asarray(omega)))
        upper.loglog(frequency, np.abs(response), color=colour, linestyle=dash, label=name)
        lower.semilogx(frequency, np.degrees(np.unwrap(np.angle(response))), color=colour, linestyle=dash)
    upper.set(ylabel="|H| (N/mm)")
    upper.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    upper.yaxis.set_minor_formatter(FormatStrFormatter("%g"))
    lower.set(xlabel="frequency (Hz)", ylabel="phase (°)")
    upper.legend(frameon=False)
    return figure
