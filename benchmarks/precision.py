"""Float32 against float64 for every public result: how far apart they are, and whether that is enough.

    python benchmarks/precision.py [--write] [PART ...]      into docs/results/accuracy.md; PARTS are functions below

Both get the same inputs, rounded to float32, so that the difference is that of the arithmetic. "Needed" is what the
result is for: a hundredth of the answers' noise for latent values, a thousandth for probabilities, a thousandth of the
largest force. A few minutes, most of it compilation.
"""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests" / "support")]
jax.config.update("jax_enable_x64", True)

from datasets import SIX  # noqa: E402
from helpers import answers, model  # noqa: E402
from pages import put  # noqa: E402

from hilbo import Study, acquisition, bcm, fit, passivity, viscoelastic  # noqa: E402
from hilbo.errors import InputError  # noqa: E402
from hilbo.hyperparameters.maximum_evidence import maximise_evidence  # noqa: E402
from hilbo.search.candidates import search_points  # noqa: E402
from hilbo.study.estimate.optimum import best_point  # noqa: E402
from hilbo.viscoelastic import FOSLS  # noqa: E402

__all__ = ["main"]

TYPES = (np.float64, np.float32)


class Row(NamedTuple):
    result: str
    error: float
    needed: float
    unit: str


def apart(single, double) -> float:
    """Largest difference; NaN if one is not a number."""
    return float(np.max(np.abs(np.asarray(single, float) - np.asarray(double, float))))


def relative(single, double) -> float:
    """Largest difference over the largest value."""
    return apart(single, double) / float(np.max(np.abs(np.asarray(double, float))))


def rounded(tree, dtype):
    """Every float of a record through float32, in the wanted type."""
    return jax.tree.map(
        lambda a: a.astype(np.float32).astype(dtype) if jnp.issubdtype(a.dtype, jnp.floating) else a, tree
    )


def likelihood() -> Iterator[Row]:
    """log p and its derivatives over f in [-8, 8] at the paper's noise and a tenth of it, relative to each value."""
    f = np.linspace(-8.0, 8.0, 161, dtype=np.float32)

    def parts(dtype, noise):
        of = rounded(model(SIX[0]()).likelihood, dtype)
        of = type(of)(of.thresholds, jnp.asarray(np.float32(noise), dtype))
        orders = [of.log_prob]
        for _ in range(3):
            orders.append(jax.grad(orders[-1]))
        points = jnp.asarray(f.astype(dtype))
        return [jax.vmap(lambda q, g=g: jax.vmap(lambda v: g(v, q))(points))(jnp.arange(3)) for g in orders]

    names = ("log_prob", "its first derivative", "its second derivative", "its third derivative")
    for noise in (0.5, 0.05):
        double, single = (jax.jit(lambda dtype=dtype, noise=noise: parts(dtype, noise))() for dtype in TYPES)
        for name, low, high in zip(names, single, double, strict=True):
            size = np.maximum(np.abs(high), 1e-6 * np.max(np.abs(high)))
            yield Row(
                f"likelihood: {name}, noise {noise:g}", float(np.max(np.abs(low - high) / size)), 1e-3, "relative"
            )


def inference() -> Iterator[Row]:
    """Worst over the six small data sets; noise 0.1 to 0.9."""
    names = ("mean", "sd", "log evidence", "class probabilities")
    needed, units = (1e-3, 1e-3, 1e-2, 1e-3), ("prior sd", "prior sd", "", "")
    for method in ("laplace", "ep", "ep_corrected", "exact"):
        worst, failed = np.zeros(4), 0
        for make in SIX:
            data, by_dtype = make(), []
            for dtype in TYPES:
                gp = rounded(model(data), dtype)
                trials = rounded(answers(data), dtype)
                x = jnp.asarray(data.x_new.astype(np.float32).astype(dtype))
                posterior = fit(gp, trials, inference=method, throw=False)
                mean, variance = posterior.predict(x)
                failed += not bool(posterior.certificate.converged)
                by_dtype.append((mean, jnp.sqrt(variance), posterior.log_evidence, posterior.class_probabilities(x)))
            scale = np.array([data.variance**0.5, data.variance**0.5, 1.0, 1.0])
            worst = np.maximum(worst, [apart(b, a) for a, b in zip(*by_dtype, strict=True)] / scale)
        for name, error, limit, unit in zip(names, worst, needed, units, strict=True):
            yield Row(f"fit, {method}: {name}", error if not failed else np.nan, limit, unit)


def gradients() -> Iterator[Row]:
    """Of the evidence, in theta, variance, noise and thresholds; near-separable answers, noise 0.1."""
    data = SIX[2]()
    for method in ("laplace", "ep", "ep_corrected"):

        def slopes(gp, trials, method=method):
            return jax.grad(lambda g: fit(g, trials, inference=method, throw=False).log_evidence)(gp)

        double, single = (
            jax.tree.leaves(jax.jit(slopes)(rounded(model(data), dtype), rounded(answers(data), dtype)))
            for dtype in TYPES
        )
        error = max(relative(low, high) for low, high in zip(single, double, strict=True))
        yield Row(f"gradient of the log evidence, {method}", error, 1e-2, "relative")


def hyperparameters() -> Iterator[Row]:
    data = SIX[1]()
    learnt = [
        maximise_evidence(rounded(model(data), d), rounded(answers(data), d), ("noise",), starts=1) for d in TYPES
    ]
    error = relative(learnt[1].gp.likelihood.noise, learnt[0].gp.likelihood.noise)
    yield Row("maximise_evidence: learnt noise", error, 1e-2, "relative")


def committee() -> Iterator[Row]:
    """24 people who explain from a millionth to nearly all of the prior variance."""
    rng = np.random.default_rng(0)
    explained = (10 ** rng.uniform(-6, -0.01, (24, 200))).astype(np.float32)
    means = rng.standard_normal((24, 200)).astype(np.float32)
    for name, of, second in (
        ("combine", bcm.combine, np.float32(1) - explained),
        ("combine_explained", bcm.combine_explained, explained),
    ):
        high, low = (of(jnp.asarray(means, d), jnp.asarray(second, d), jnp.asarray(1.0, d)) for d in TYPES)
        yield Row(f"bcm.{name}: mean", relative(low[0], high[0]), 1e-3, "relative")
        yield Row(f"bcm.{name}: sd", relative(jnp.sqrt(low[1]), jnp.sqrt(high[1])), 1e-3, "relative")


def choices() -> Iterator[Row]:
    """Scores of 5,120 candidates in the preset's box, and what is chosen from them by all of float32."""
    study = Study.load(ROOT / "hilbo" / "data" / "paper.toml")
    candidates = search_points(study.space, 3)
    x = np.asarray(candidates[:25])
    q = 2 - np.searchsorted([0.25, 0.5], np.linalg.norm(x - x[7], axis=1))
    scores = {
        "UCB": acquisition.UCB(0.7),
        "LogEI": acquisition.LogEI(jnp.asarray(0.9)),
        "TopCategory": acquisition.TopCategory(0.5, 0.5),
    }
    by_dtype = []
    for dtype in TYPES:
        trials = rounded(type(answers(SIX[0]()))(jnp.asarray(x), jnp.asarray(q), jnp.ones(25, bool)), dtype)
        posterior = fit(rounded(study.gp, dtype), trials)
        at = posterior.predict(jnp.asarray(np.asarray(candidates, np.float32).astype(dtype)))
        by_dtype.append((posterior, {name: np.asarray(score(*at), float) for name, score in scores.items()}))
    for name in scores:
        high, low = (values[name] for _, values in by_dtype)
        yield Row(f"acquisition.{name}: value", apart(low, high), 1e-3, "prior sd, or log")
        loss = float(np.max(high) - high[np.argmax(low)])
        yield Row(f"acquisition.{name}: loss of the chosen candidate", loss, 1e-4, "prior sd, or log")
    best = [
        best_point(study.goal, study.space, posterior.astype(np.float64), candidates).x for posterior, _ in by_dtype
    ]
    yield Row("best_point, from a posterior fitted in float32", apart(best[1], best[0]), 1e-2, "of the search range")


SET = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}


def renderings() -> Iterator[Row]:
    t = np.arange(3000) * 1e-3
    x = (2.0 - 2.0 * np.cos(2 * np.pi * 1.7 * t) + 0.1 * np.sin(2 * np.pi * 40 * t)).astype(np.float32)
    omega = np.geomspace(1.0, np.pi / 1e-3, 400).astype(np.float32)
    for memory in ("short", "full"):
        own = SET if memory == "short" else {**SET, "K0": 0.44}
        high, low = (FOSLS(**{k: jnp.asarray(np.float32(v), d) for k, v in own.items()}, memory=memory) for d in TYPES)

        def row(name, of: Callable, limit, unit, high=high, low=low, memory=memory):
            return Row(f"FOSLS, {memory} memory: {name}", relative(of(low), of(high)), limit, unit)

        yield row("simulate, 3 s", lambda m: m.simulate(x), 1e-3, "of the largest force")
        yield row("simulate_force, 3 s", lambda m: m.simulate_force(x), 1e-3, "of the largest position")
        yield row("frequency_response", lambda m: np.abs(m.frequency_response(omega)), 1e-3, "of the largest")
        yield row("dc_gain", lambda m: m.dc_gain(), 1e-3, "relative")
        yield row("effective_damping", lambda m: m.effective_damping(), 1e-3, "relative")
        yield row("settling_time(0.9)", lambda m: m.settling_time(0.9), 1e-2, "relative")


def closed_forms() -> Iterator[Row]:
    rng = np.random.default_rng(1)
    K1, B1 = rng.uniform(1, 32, 2000).astype(np.float32), rng.uniform(0.001, 32, 2000).astype(np.float32)
    alpha = rng.uniform(0.01, 0.99, 2000).astype(np.float32)

    def both(of, *args):
        double, single = (np.asarray(of(*(a.astype(d) for a in args)), float) for d in TYPES)
        return single, double

    single, double = both(lambda a: jax.vmap(lambda v: viscoelastic.gl_coefficients(v, 101))(a), alpha)
    yield Row("gl_coefficients, N = 101", float(np.max(np.abs(single / double - 1))), 1e-3, "relative")
    single, double = both(lambda *a: viscoelastic.K0_from_effective_stiffness(*a, a[0].dtype.type(0.44)), K1, B1, alpha)
    yield Row("K0_from_effective_stiffness", apart(single, double) / 0.44, 1e-3, "of K_eff")
    single, double = both(lambda *a: passivity.minimum_damping(*a, a[0].dtype.type(0.44)), K1, B1, alpha)
    yield Row("passivity.minimum_damping", float(np.max(np.abs(single / double - 1))), 1e-3, "relative")
    single, double = both(lambda *a: passivity.largest_K1(*a, a[0].dtype.type(0.95), a[0].dtype.type(0.44)), B1, alpha)
    bounded = np.isfinite(double) & (double < 32)
    error = float(np.max(np.abs(single[bounded] / double[bounded] - 1)))
    yield Row("passivity.largest_K1, up to 32 N/mm", error, 1e-3, "relative")
    limits = []
    for dtype in TYPES:
        m = FOSLS(**{k: jnp.asarray(np.float32(v), dtype) for k, v in SET.items()})
        certificate = passivity.certify(m, jnp.asarray(0.95, dtype))
        limits.append(
            np.array([float(v) for v in jax.tree.leaves(certificate) if jnp.issubdtype(v.dtype, jnp.floating)])
        )
    yield Row("passivity.certify: its numbers", float(np.max(np.abs(limits[1] - limits[0]))), 1e-3, "N.s/m")


PARTS = (likelihood, inference, gradients, hyperparameters, committee, choices, renderings, closed_forms)

PAGE = """Made by `python benchmarks/precision.py --write`. Both precisions get the same inputs, rounded to float32.

"Needed" is the accuracy for the use of the result. The responses have a noise of 0.5, or 0.1 at least: an error of a
hundredth of that changes no decision. A force needs a thousandth of the largest. NaN: the diagnostics fail in float32.

| result | error of float32 | needed | enough |
|---|---:|---:|---|
{rows}

{verdict}

Identification is done in float64 (`hilbo identify` switches it on): its profile intervals take second differences of
sums of squares, which float32 cannot resolve. The case beyond float32, a
prior sd of more than about 100 noises, is in [stress](#stress).
"""


def main():
    rows = []
    asked = [name for name in sys.argv[1:] if name != "--write"]
    for part in (part for part in PARTS if not asked or part.__name__ in asked):
        try:
            rows += list(part())
        except InputError as error:
            rows.append(Row(f"{part.__name__}: refused: {error}", np.nan, np.nan, ""))
        print(f"{part.__name__} done", file=sys.stderr)
    lines = [
        f"| {r.result} | {r.error:.0e} {r.unit} | {r.needed:.0e} | {'yes' if r.error <= r.needed else 'NO'} |"
        for r in rows
    ]
    short = [r.result for r in rows if not r.error <= r.needed]
    verdict = (
        f"Float32 is enough for {len(rows) - len(short)} of {len(rows)} results. Not for: " + "; ".join(short) + "."
        if short
        else "Float32 is enough for all of these."
    )
    text = PAGE.format(rows="\n".join(lines), verdict=verdict)
    print(text)
    if "--write" in sys.argv[1:]:
        put("results/accuracy.md", "precision", text)


if __name__ == "__main__":
    main()
