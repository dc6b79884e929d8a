"""Hyperparameters by maximum evidence, with or without weak priors, for one participant or shared by all.

Unconstrained coordinates: log theta, log variance, log noise, the first threshold in prior standard deviations, and the
logs of the gaps between thresholds, so that learnt thresholds stay ordered. Hyperparameters that are not learnt keep
the model's values. Two invariances of the model have to be removed: its scale (f, thresholds and noise times s,
variance times s^2, give the same probabilities), by not learning all of variance, noise and thresholds together; and
its shift, which the prior's mean 0 fixes.

Weak priors, centred at the model's own values: log theta sd 1.5, log variance, log noise and log gaps sd 1, first
threshold sd 1 in units of the prior's standard deviation. With few ordinal responses the evidence often has no maximum
(theta to 0 or infinity); the result then reports that (`runaway`).

The search is Newton's method with a trust region, which takes 6 to 20 steps, a quasi-Newton one 30 to 100. The
evidences by Laplace's method and by EP have gradients and Hessians in closed form
(`hilbo.hyperparameters.laplace_evidence`, `hilbo.hyperparameters.ep_evidence`), and modes and cavities are started from
extrapolations of the last ones; the evidence by corrected EP is differentiated automatically. Of several starts, those
that approach the end of an earlier one stop there. Reference: Rasmussen & Williams (2006), section 5.5.1; paper,
section IV-3 (robustness check).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int, PyTree

from hilbo.errors import InputError
from hilbo.gaussian import Scalar
from hilbo.hyperparameters.coordinates import Coordinates, Learnable, coordinates_of, model_at
from hilbo.hyperparameters.cost import divisor, evidence_cost
from hilbo.numerics.linalg import eigh, one_at_a_time
from hilbo.numerics.newton import Expansion, TrustRegionNewton, arrives
from hilbo.numerics.polytope import Polytope, projector, walls_of_cube
from hilbo.numerics.shown import has_values, shown
from hilbo.ordinal_gp import OrdinalGP, Trials

__all__ = ["MaximumEvidence", "maximise_evidence", "maximise_shared_evidence", "optimum_sensitivity"]

_MOST_STEPS = 100
_RUNAWAY = 6.9  # a factor of 1000: largest change of a hyperparameter that counts as a maximum
_AT_A_WALL = 1e-6  # of a coordinate's range
_FLAT = (
    1e-3  # curvature of the log evidence below which a hyperparameter is undetermined by a factor exp(30) either way
)


class MaximumEvidence(eqx.Module):
    """Model with learnt hyperparameters, and the outcome of the search; leading axes for several participants.

    `log_evidence` is without the weak priors; `converged`: the gradient vanished, and the fits at the end are
    certified; `runaway`: a hyperparameter changed by more than a factor 1000 or is undetermined, so that the evidence
    has no maximum in reach.
    """

    gp: OrdinalGP
    log_evidence: Float[Array, "*M"]
    """Log evidence of the responses, without the weak priors."""
    steps: Int[Array, "*M"]
    converged: Bool[Array, "*M"]
    """The gradient vanished, and the fits at the end are certified."""
    runaway: Bool[Array, "*M"]
    """A hyperparameter moved by more than a factor 1000, or may move by more than exp(30) at no cost: the evidence has
    no maximum in reach."""
    learn: tuple[str, ...] = eqx.field(static=True)

    def __repr__(self) -> str:
        """One line: the model, what was learnt, log evidence, and how the search ended; the fields of a traced one."""
        if not has_values(self.log_evidence, self.steps, self.converged, self.runaway):
            return eqx.tree_pformat(self)
        ended = "a hyperparameter ran away" if np.any(self.runaway) else "converged"
        ended = ended if np.all(self.converged) else "NOT converged"
        learnt, evidence = ", ".join(self.learn), shown(self.log_evidence)
        return f"MaximumEvidence({self.gp!r}; learnt {learnt}; log evidence {evidence}, {ended})"


def maximise_evidence(
    gp: OrdinalGP,
    trials: Trials,
    learn: Sequence[str] = ("theta", "noise"),
    *,
    weak_priors: bool = False,
    starts: int = 4,
    inference: str = "laplace",
) -> MaximumEvidence:
    """Hyperparameters that maximise the evidence of one participant's responses.

    Use `jax.vmap` for individual ones of several.

    **Arguments:**

    - `gp`: starting values, and the values of hyperparameters that are not learnt.
    - `learn`: which of "theta", "variance", "noise", "thresholds". A `theta` of shape (d,) is learnt per dimension.
    - `weak_priors`: add the log prior above.
    - `inference`: method of the evidence, "laplace", "ep" or "ep_corrected"; "exact" has no derivatives.
    - `starts`: number of searches, from the model's values with theta and noise scaled by powers of 4 and 1/2; the best
      one wins.

    Raises `InputError` for unknown or no names in `learn`, for variance, noise and thresholds together, and for an
    inference without derivatives. A search that fails does not raise: read `converged` and `runaway`.
    """
    options = _Options(_checked(learn, inference), weak_priors, starts, inference)
    return _maximise(gp, jax.tree.map(lambda leaf: leaf[None], trials), options)


def maximise_shared_evidence(
    gp: OrdinalGP,
    trials: Trials,
    learn: Sequence[str] = ("theta", "noise", "thresholds"),
    *,
    weak_priors: bool = False,
    starts: int = 4,
    inference: str = "laplace",
) -> MaximumEvidence:
    """One set of hyperparameters for all participants (`trials` stacked, (M, n)): maximises the sum of their log
    evidences.

    Arguments as for [`maximise_evidence`][]. Raises `InputError` for unknown or no names in `learn`, for variance,
    noise and thresholds together, and for an inference without derivatives.
    """
    return _maximise(gp, trials, _Options(_checked(learn, inference), weak_priors, starts, inference))


class _Options(NamedTuple):
    """Options of the search; static."""

    learn: tuple[str, ...]
    weak_priors: bool
    starts: int
    inference: str


def _maximise(gp: OrdinalGP, trials: Trials, options: _Options) -> MaximumEvidence:
    """`_search`, in a form for `vmap`: participant by participant on a CPU, each search stopping when it has
    converged.
    """
    return one_at_a_time(lambda gp, trials: _search(gp, trials, options))(gp, trials)


def _search(gp: OrdinalGP, trials: Trials, options: _Options) -> MaximumEvidence:
    """Search from several starts and return the best result, converged or not; `trials` (M, n) are stacked.

    One set of hyperparameters for all of them. The options are not checked.
    """
    expand, nothing = evidence_cost(gp, trials, options.learn, options.weak_priors, options.inference)

    def cost(coordinates, _):
        """Value of the expansion; only its shape is used."""
        expansion = expand(coordinates, nothing)
        return expansion.value, expansion.aux

    def ended(carry, start):
        earlier_ends, last = carry
        first = expand(start, last)
        solution = optx.minimise(
            cost,
            TrustRegionNewton(),
            start,
            has_aux=True,
            max_steps=_MOST_STEPS,
            throw=False,
            options={"expand": expand, "begun": first, "known": earlier_ends},
        )
        # Ends without a certificate, and ends that an earlier search has reached, cannot win.
        end, joined = solution.state.here, arrives(solution.value, solution.state.move, earlier_ends)
        certified = end.aux.certified
        value = jnp.where(certified & jnp.isfinite(end.value) & ~joined, end.value, jnp.inf)
        done = (solution.result == optx.RESULTS.successful) & certified
        own_end = jnp.where(done & ~joined, end.aux.coordinates, jnp.nan)
        ends = jnp.concatenate([earlier_ends[1:], own_end[None, :]])
        steps = jnp.asarray(solution.stats["num_steps"]) + 1
        flat = _flat(end, trials)
        return (ends, first.aux), _End(solution.value, value, end.aux.log_evidence, steps, done, flat)

    initial = coordinates_of(gp, options.learn)
    # One search after the other: each stops when converged or near the end of an earlier one; its first evaluation
    # evidence is searched from the previous one's.
    no_ends = jnp.full((options.starts, nothing.coordinates.size), jnp.nan, nothing.coordinates.dtype)
    _, ends = jax.lax.scan(ended, (no_ends, nothing), _starting_points(initial, options.starts))
    end = _best(ends, options.starts)
    runaway = end.flat
    for name in sorted(initial.keys() - {"first"}):  # in one order, so that every process makes the same program
        runaway |= jnp.any(jnp.abs(end.coordinates[name] - initial[name]) > _RUNAWAY)
    return MaximumEvidence(model_at(end.coordinates, gp), end.log_evidence, end.steps, end.done, runaway, options.learn)


class _End(NamedTuple):
    """End of one search; `value` is infinite if it cannot win."""

    coordinates: Coordinates
    value: Scalar
    log_evidence: Scalar
    steps: Int[Array, ""]
    done: Bool[Array, ""]
    flat: Bool[Array, ""]


def _best(ends: _End, starts: int) -> _End:
    """Best of the stacked ends: the one with the smallest `value`.

    In a tie the search from the model itself wins, as without responses or certified ends.
    """
    model_first = (jnp.arange(starts) + _row_of_model(starts)) % starts
    best = model_first[jnp.argmin(ends.value[model_first])]
    return jax.tree.map(lambda leaf: leaf[best], ends)


def _flat(end: Expansion, trials: Trials) -> Bool[Array, ""]:
    """Whether some hyperparameter is undetermined: the smallest curvature of the objective, times `divisor`, is below
    `_FLAT`.
    """
    return eigh(end.hessian)[0][0] * divisor(trials) < _FLAT


def _checked(learn: Sequence[str], inference: str) -> tuple[str, ...]:
    """Return `learn` as a tuple.

    Raises `InputError` for unknown or no names, for variance, noise and thresholds together, and for exact inference.
    """
    learn = tuple(learn)
    unknown = [name for name in learn if name not in get_args(Learnable)]
    if unknown or not learn:
        asked = f'"{unknown[0]}"' if unknown else "nothing"
        raise InputError(f"hyperparameters: cannot learn {asked}; choose from {', '.join(get_args(Learnable))}.")
    if {"variance", "noise", "thresholds"} <= set(learn):
        raise InputError(
            "hyperparameters: variance, noise and thresholds cannot all be learnt, because the scale of the latent"
            " function would be free; leave one of them fixed."
        )
    if inference == "exact":
        raise InputError(
            'hyperparameters: inference "exact" has no derivatives to learn by; use "ep", which is near it.'
        )
    return learn


def _row_of_model(starts: int) -> int:
    """Index of the starting point that is the model itself, the middle one."""
    return (starts - 1) // 2


def _starting_points(initial: Coordinates, starts: int) -> Coordinates:
    """Starting points, stacked along a first axis: theta times rising powers of 4, noise times rising powers of 1/2,
    the model itself in the middle; other coordinates unchanged.
    """
    power = (jnp.arange(starts) - _row_of_model(starts)).astype(initial[next(iter(initial))].dtype)
    step = {"theta": 1.4, "noise": -0.7}  # 4 and 1/2, as logarithms
    return {
        name: value[None] + (step.get(name, 0.0) * power).reshape(-1, *(1,) * value.ndim)
        for name, value in initial.items()
    }


def optimum_sensitivity(
    height: Callable[[Float[Array, " d"], PyTree], Scalar],
    refit: Callable[[OrdinalGP], PyTree],
    w: Float[Array, " d"],
    gp: OrdinalGP,
    from_box: Callable[[Float[Array, " d"]], Float[Array, " d"]],
    learn: Sequence[str] = ("theta", "noise", "thresholds"),
    *,
    walls: Polytope | None = None,
    held: Bool[Array, " d"] | None = None,
) -> Coordinates:
    """Derivative of an optimum x (unit cube) by each learnt hyperparameter: a record of arrays (d, ...) by coordinate.

    At a maximum the gradient along free directions is 0, so that by the implicit function theorem dw = -H^-1
    d(gradient) there; directions across an active wall stay fixed. Positive hyperparameters are on a log scale.

    **Arguments:**

    - `height`: of the map at box coordinates (d,), given the result of `refit`; `w` (d,): box coordinates of its
      maximum.
    - `refit`: model -> data of the map, for `height`; `gp`: the model at which to differentiate.
    - `from_box`: box coordinates (d,) -> point of the unit cube (d,).
    - `walls`: constraints of the maximum in addition to the cube's.
    - `held`: coordinates with discrete steps, which a small change does not move; has an effect only with `walls`.
    """
    coordinates = coordinates_of(gp, learn)
    # Forward over forward: forward over reverse drops custom derivative rules inside a scan (docs/design.md).
    slope = jax.jacfwd(height)
    free = _free_directions(w, walls, held)
    hessian = jax.jacfwd(slope)(w, refit(gp))
    along = free @ hessian @ free - (jnp.eye(w.shape[0], dtype=w.dtype) - free)
    mixed = jax.jacfwd(lambda c: free @ slope(w, refit(model_at(c, gp))))(coordinates)
    to_unit = jax.jacfwd(from_box)(w)

    def moved(block):
        return (-to_unit @ jnp.linalg.solve(along, block.reshape(w.shape[0], -1))).reshape(block.shape)

    return jax.tree.map(moved, mixed)


def _free_directions(
    w: Float[Array, " d"], walls: Polytope | None, held: Bool[Array, " d"] | None
) -> Float[Array, "d d"]:
    """Projection (d, d) onto the directions in which a maximum at `w` (d,) may move: those along its active walls, and
    not those of `held` coordinates. Without `walls`, `held` is ignored.
    """
    inside = (w > _AT_A_WALL) & (w < 1.0 - _AT_A_WALL)
    if walls is None:
        return jnp.diag(inside.astype(w.dtype))
    still = jnp.zeros_like(inside) if held is None else held
    around = walls_of_cube(walls, still, w)
    return projector(around.normals, around.offsets <= _AT_A_WALL) * (~still).astype(w.dtype)[None, :]
