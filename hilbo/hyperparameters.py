"""Hyperparameters by maximum evidence, alone or with weak priors, for one participant or shared by all.

Unconstrained coordinates: log theta, log variance, log noise, the first threshold and the logs of the gaps between
thresholds, so that learnt thresholds stay ordered. What is not learnt keeps the model's value. Two freedoms of the
model have to be fixed: its scale (f, thresholds and noise times s, variance times s^2, give the same answers), by not
learning all of variance, noise and thresholds together; and its shift, which the prior's mean 0 fixes.

Weak priors, centred at the model's own values: log theta sd 1.5, log variance, log noise and log gaps sd 1, first
threshold sd 1 in units of the prior's standard deviation. Few ordinal answers often leave the evidence without a
maximum (theta to 0 or infinity); the result then says so instead of printing digits.

The search is Newton's method with a trust radius, which takes 6 to 20 steps, a quasi-Newton one 30 to 100.
Laplace's evidence has its gradient and Hessian in closed form (`hilbo.evidence`), and its modes are sought from where
the last ones point; EP's is differentiated automatically. Of several starts, those that go where an earlier one ended
stop there.
Reference: Rasmussen & Williams (2006), section 5.5.1; paper, section IV-3 (robustness check).
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PyTree

from hilbo.errors import InputError
from hilbo.evidence import Evidence, laplace_evidence
from hilbo.kernels import gram
from hilbo.linalg import eigh, one_at_a_time
from hilbo.newton import TrustRegionNewton, arrives
from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit, OrdinalTerms, Trials, fit

__all__ = ["Learnable", "Learned", "log_prior", "maximise_evidence", "maximise_shared_evidence", "optimum_sensitivity"]

Learnable = Literal["theta", "variance", "noise", "thresholds"]
Coordinates = dict[str, Float[Array, "..."]]

_RUNAWAY = 6.9  # a factor of 1000: that far from where the search began there is no maximum to speak of
_FLAT = 1e-3  # curvature of the log evidence: less leaves a hyperparameter open by a factor exp(30) either way
_PRIOR_SD = {"theta": 1.5, "variance": 1.0, "noise": 1.0, "first": 1.0, "gaps": 1.0}
_OWN = ("first", "gaps", "noise")  # coordinates of the likelihood; in a sorted record they come before the kernel's
_FIELDS = {"theta": ("theta",), "variance": ("variance",), "noise": ("noise",), "thresholds": ("first", "gaps")}


class Learned(eqx.Module):
    """A model with learnt hyperparameters, and how the search for it ended; leading axes for several people."""

    gp: OrdinalGP
    log_evidence: Float[Array, "*M"]
    """Of the answers, without the prior's part."""
    steps: Int[Array, "*M"]
    converged: Bool[Array, "*M"]
    """The gradient vanished, and every fit on the way to it held its certificate at the end."""
    runaway: Bool[Array, "*M"]
    """A hyperparameter moved by more than a factor 1000, or may move by more than exp(30) at no cost: the evidence has
    no maximum in reach."""
    learn: tuple[str, ...] = eqx.field(static=True)


def maximise_evidence(
    gp: OrdinalGP,
    trials: Trials,
    learn: Sequence[str] = ("theta", "noise"),
    *,
    weak_priors: bool = False,
    starts: int = 4,
    max_steps: int = 100,
    inference: str = "laplace",
) -> Learned:
    """The hyperparameters under which one person's answers are most probable; under `jax.vmap`, each person's own.

    **Arguments:**

    - `gp`: starting values, and the values of what is not learnt.
    - `learn`: which of "theta", "variance", "noise", "thresholds". A `theta` of shape (d,) is learnt per dimension.
    - `weak_priors`: add the log prior above.
    - `inference`: whose evidence, "laplace", "ep" or "ep_corrected"; "exact" has no derivatives.
    - `starts`: the search begins at the model's values with theta and noise scaled by powers of 2; the best end wins.
    """
    return _maximise(
        gp, jax.tree.map(lambda leaf: leaf[None], trials), learn, weak_priors, starts, max_steps, inference
    )


def maximise_shared_evidence(
    gp: OrdinalGP,
    trials: Trials,
    learn: Sequence[str] = ("theta", "noise", "thresholds"),
    *,
    weak_priors: bool = False,
    starts: int = 4,
    max_steps: int = 100,
    inference: str = "laplace",
) -> Learned:
    """One set of hyperparameters for all participants (`trials` stacked): maximises the sum of their log evidences."""
    return _maximise(gp, trials, learn, weak_priors, starts, max_steps, inference)


def log_prior(gp: OrdinalGP, centre: OrdinalGP, learn: Sequence[str]) -> Float[Array, ""]:
    """Log density of the weak priors at `gp`, up to a constant; `centre` is where they are centred."""
    here, there = _coordinates(gp, learn), _coordinates(centre, learn)
    scale = dict.fromkeys(here, 1.0) | {"first": jnp.sqrt(centre.kernel.variance)}
    parts = [jnp.sum(((here[k] - there[k]) / (_PRIOR_SD[k] * scale[k])) ** 2) for k in here]
    return -0.5 * jnp.sum(jnp.stack(parts))


def _maximise(gp, trials, learn, weak_priors, starts, max_steps, inference):
    learn = _checked(learn)
    if inference == "exact":
        raise InputError(
            'hyperparameters: inference "exact" has no derivatives to learn by; use "ep", which is near it.'
        )
    options = _Search(learn, weak_priors, starts, max_steps, inference)
    # Person by person on a CPU: each search stops when it is done, where a batch would wait for its slowest.
    return one_at_a_time(lambda gp, trials: _searched(gp, trials, options))(gp, trials)


class _Search(NamedTuple):
    learn: tuple[str, ...]
    weak_priors: bool
    starts: int
    max_steps: int
    inference: str


def _searched(gp, trials, options):
    # Per answer the cost has curvatures near 1, so that the first step, down the bare gradient, is a sensible one.
    answers = jnp.sum(trials.mask, dtype=gp.likelihood.noise.dtype) + 1.0
    objective = _closed if options.inference == "laplace" else _differentiated
    fn, expand = objective(gp, trials, options, answers)

    def ended(known, start):
        solution = optx.minimise(
            fn,
            TrustRegionNewton(),
            start,
            has_aux=True,
            max_steps=options.max_steps,
            throw=False,
            options=expand | {"known": known},
        )
        evidence, certified = solution.aux[:2]
        # An evidence without its certificate is no evidence: such an end never wins. Nor one that is known already.
        end, joined = solution.state.here, arrives(solution.value, solution.state.move, known)
        value = jnp.where(certified & jnp.isfinite(end.value) & ~joined, end.value, jnp.inf)
        done = (solution.result == optx.RESULTS.successful) & certified
        flat = eigh(end.hessian)[0][0] * answers < _FLAT
        found = jnp.where(done & ~joined, ravel_pytree(solution.value)[0], jnp.nan)
        known = jnp.concatenate([known[1:], found[None, :]])
        return known, (solution.value, value, evidence, done, flat, jnp.asarray(solution.stats["num_steps"]))

    begin = _coordinates(gp, options.learn)
    # One search after the other: each stops when it is done, or on its way to where an earlier one ended.
    unknown = jnp.full((options.starts, ravel_pytree(begin)[0].size), jnp.nan, answers.dtype)
    _, (ends, values, evidences, done, flat, steps) = jax.lax.scan(ended, unknown, _spread(begin, options.starts))
    best = jnp.argmin(values)
    chosen = jax.tree.map(lambda leaf: leaf[best], ends)
    moved = [jnp.max(jnp.abs(chosen[k] - begin[k])) for k in chosen if k != "first" and chosen[k].size]
    runaway = (jnp.max(jnp.stack(moved)) > _RUNAWAY) | flat[best]
    return Learned(_model(chosen, gp), evidences[best], steps[best], done[best], runaway, options.learn)


def _differentiated(gp, trials, options, answers):
    """The cost, by automatic differentiation."""

    def cost(coordinates, _):
        model = _model(coordinates, gp)
        evidence, certified = _evidence(model, trials, options.inference)
        prior = log_prior(model, gp, options.learn) if options.weak_priors else jnp.zeros_like(evidence)
        return -(evidence + prior) / answers, (evidence, certified)

    return cost, {}


def _closed(gp, trials, options, answers):
    """The cost with Laplace's evidence, by its closed derivatives; the modes are sought from the last ones."""

    def prior(coordinates):
        return log_prior(_model(coordinates, gp), gp, options.learn)

    def expand(coordinates, last, aux):
        flat, restore = ravel_pytree(coordinates)
        ahead = flat - ravel_pytree(last)[0]
        _, _, weights, moved = aux
        found = _people(gp, trials, coordinates, weights + moved @ ahead)
        value, gradient, hessian = (jnp.sum(part, axis=0) for part in found[:3])
        evidence = value
        if options.weak_priors:
            value, gradient = value + prior(coordinates), gradient + jax.grad(lambda at: prior(restore(at)))(flat)
            hessian = hessian + jax.hessian(lambda at: prior(restore(at)))(flat)
        kept = evidence, jnp.all(found.certified), found.weights, found.moved
        return -value / answers, -gradient / answers, -hessian / answers, kept

    def cost(coordinates, _):
        nothing = jnp.zeros(trials.q.shape, answers.dtype)
        count = ravel_pytree(coordinates)[0].size
        kept = jnp.zeros_like(answers), jnp.zeros((), bool), nothing, jnp.zeros((*nothing.shape, count), answers.dtype)
        value, _, _, kept = expand(coordinates, coordinates, kept)
        return value, kept

    return cost, {"expand": expand}


@one_at_a_time
def person_evidence(gp: OrdinalGP, coordinates: Coordinates, trials: Trials, start: Float[Array, " n"]) -> Evidence:
    """One person's evidence by Laplace's method, expanded in the coordinates, which are in alphabetical order.

    `start`: weights near which the mode is sought.
    """
    own = {name: value for name, value in coordinates.items() if name in _OWN}
    shape = {name: value for name, value in coordinates.items() if name not in _OWN}
    (flat_own, restore_own), (flat_shape, restore_shape) = ravel_pytree(own), ravel_pytree(shape)

    def covariance(at):
        return gram(_model(own | restore_shape(at), gp).kernel, trials.x, trials.x)

    def terms(at):
        return OrdinalTerms(_model(restore_own(at) | shape, gp).likelihood, trials.q, trials.mask)

    return laplace_evidence(covariance, terms, flat_own.astype(start.dtype), flat_shape.astype(start.dtype), start)


def _people(gp, trials, coordinates, starts):
    if starts.shape[0] > 1:
        return jax.vmap(person_evidence, in_axes=(None, None, 0, 0))(gp, coordinates, trials, starts)
    alone = person_evidence(gp, coordinates, jax.tree.map(lambda leaf: leaf[0], trials), starts[0])
    return jax.tree.map(lambda leaf: leaf[None], alone)


def _evidence(gp, trials, inference):
    """Summed log evidence of stacked trials, and whether every certificate holds."""

    def one(person):
        posterior = fit(gp, person, inference=inference, throw=False)
        return posterior.log_evidence, posterior.certificate.converged

    evidences, converged = jax.vmap(one)(trials)
    return jnp.sum(evidences), jnp.all(converged)


def _checked(learn):
    learn = tuple(learn)
    unknown = [name for name in learn if name not in get_args(Learnable)]
    if unknown or not learn:
        found = f'"{unknown[0]}"' if unknown else "nothing"
        raise InputError(f"hyperparameters: asked to learn {found}; choose from {', '.join(get_args(Learnable))}.")
    if {"variance", "noise", "thresholds"} <= set(learn):
        raise InputError(
            "hyperparameters: variance, noise and thresholds cannot all be learnt, because the scale of the latent"
            " function would be free; leave one of them fixed."
        )
    return learn


def _coordinates(gp: OrdinalGP, learn: Sequence[str]) -> Coordinates:
    thresholds = gp.likelihood.thresholds
    every = {
        "theta": jnp.log(gp.kernel.theta),
        "variance": jnp.log(gp.kernel.variance),
        "noise": jnp.log(gp.likelihood.noise),
        "first": thresholds[0],
        "gaps": jnp.log(jnp.diff(thresholds)),
    }
    return {field: every[field] for name in learn for field in _FIELDS[name]}


def _model(coordinates: Coordinates, gp: OrdinalGP) -> OrdinalGP:
    """The model at these coordinates; what they do not mention is as in `gp`."""
    held = {"theta": gp.kernel.theta, "variance": gp.kernel.variance, "noise": gp.likelihood.noise}
    positive = held | {k: jnp.exp(coordinates[k]) for k in held if k in coordinates}
    thresholds = gp.likelihood.thresholds
    if "first" in coordinates:
        steps = jnp.concatenate([coordinates["first"][None], jnp.exp(coordinates["gaps"])])
        thresholds = jnp.cumsum(steps)
    return OrdinalGP(RBF(positive["theta"], positive["variance"]), OrdinalProbit(thresholds, positive["noise"]))


def _spread(begin: Coordinates, starts: int) -> Coordinates:
    """Starting points: the model itself, then theta (and noise, the other way) by alternating powers of 2."""
    index = jnp.arange(starts)
    power = jnp.where(index % 2 == 1, (index + 1) // 2, -(index // 2)).astype(begin[next(iter(begin))].dtype)
    step = {"theta": 1.4, "noise": -0.7}  # 4 and 1/2, as logarithms
    return {
        name: value[None] + (step.get(name, 0.0) * power).reshape(-1, *(1,) * value.ndim)
        for name, value in begin.items()
    }


def optimum_sensitivity(
    height: Callable[[Float[Array, " d"], PyTree], Float[Array, ""]],
    refit: Callable[[OrdinalGP], PyTree],
    w: Float[Array, " d"],
    gp: OrdinalGP,
    from_box: Callable[[Float[Array, " d"]], Float[Array, " d"]],
    learn: Sequence[str] = ("theta", "noise", "thresholds"),
) -> Coordinates:
    """How an optimum moves with the hyperparameters: d x / d(coordinate), (d, ...) in units of the search ranges.

    At a maximum over the cube the gradient along free coordinates is 0, so that by the implicit function theorem
    dw = -H^-1 d(gradient); coordinates at a wall stay there. Positive hyperparameters are on a log scale.

    **Arguments:** `height` of the map at box coordinates, given what `refit` makes of a model; its maximum `w`; the
    model; and `from_box`, to the unit cube.
    """
    coordinates = _coordinates(gp, learn)
    # Forward over forward: forward over reverse drops custom derivative rules inside a scan (docs/design.md).
    slope = jax.jacfwd(height)
    free = (w > 1e-6) & (w < 1.0 - 1e-6)
    hessian = jax.jacfwd(slope)(w, refit(gp))
    held = jnp.where(free[:, None] & free[None, :], hessian, -jnp.eye(w.shape[0], dtype=w.dtype))
    mixed = jax.jacfwd(lambda c: jnp.where(free, slope(w, refit(_model(c, gp))), 0.0))(coordinates)
    to_unit = jax.jacfwd(from_box)(w)

    def moved(block):
        return (-to_unit @ jnp.linalg.solve(held, block.reshape(w.shape[0], -1))).reshape(block.shape)

    return jax.tree.map(moved, mixed)
