"""The compiled step of a session: from answers to their posterior and the next point, in one fit.

`Session` and live sessions run this same program, so that they ask the same points bit for bit. A known posterior can
be given in place of answers; the program then only searches, so that the largest posterior mean needs no second fit.

Numbers go in and come out as one vector each, because the transfer of an array costs more than its numbers. The part of
Laplace's certificate (convergence diagnostics) that is not needed to choose a point, 5 % of a step, is computed from
the fit's numbers when the posterior is requested.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from hilbo.gaussian import GaussianPosterior, certify
from hilbo.kernels import gram
from hilbo.likelihoods import OrdinalTerms
from hilbo.numerics.tracing import OfArrays, arrays_in, prepared, program, traced_once
from hilbo.ordinal_gp import Posterior, Trials, fit
from hilbo.session.choose.selection import Choosing, Design, point_after
from hilbo.study.config import Study

__all__ = ["Fitted", "Step", "padding"]

_COUNT, _WEIGHT, _GIVEN, _FACTS = 0, 1, 2, 3  # places in a query, which goes on with categories and points
_FROM_THE_SEARCH = ("residual", "tolerance", "iterations", "jitter", "condition")  # of a certificate
_MADE_LATER = ("smallest_variance", "evidence_error", "evidence_rounding", "converged")


class Fitted(NamedTuple):
    """Result of a fit: the next point (d,) that the answers lead to, in physical units, and their posterior."""

    point: Float[np.ndarray, " d"]
    posterior: Posterior


def padding(study: Study, capacity: int) -> Float[np.ndarray, "capacity d"]:
    """Values for rows without an answer: the middle of the parameters' ranges, in physical units."""
    return np.tile([p.middle for p in study.space.parameters], (capacity, 1))


class Step:
    """The compiled step of a study and a design, called with answers.

    Everything but the answers is bound in advance, so that a call does not traverse the study: JAX gets its arrays as
    one flat tuple, because walking through the records costs more than the fit where caches are cold.
    """

    def __init__(self, study: Study, plan: Design) -> None:
        self._study, self._plan, self._choosing = study, plan, Choosing.of(study)
        self.weight, self.capacity = float(study.file.selection.weight), study.file.selection.trials
        self._low, self._high = (np.array([getattr(p, end) for p in study.space.parameters]) for end in ("low", "high"))
        self.initial: Float[np.ndarray, "s d"] = self._physical(_to_physical(study.space, plan.initial))
        self.responses, self.names = study.responses, study.space.names
        blank = padding(study, self.capacity).ravel()
        self._blank = np.concatenate([np.zeros(_FACTS + self.capacity), blank])

    def __reduce__(self) -> tuple[object, ...]:
        """Compiled programs cannot be pickled; a copy finds or compiles its own."""
        return type(self), (self._study, self._plan)

    @property
    def compiled(self) -> Any:
        """The compiled program of the step; unless programs are kept on disk, studies that differ only in numbers share
        it."""
        return self._bound.program

    def __call__(self, points: Float[np.ndarray, "n d"], answers: Any) -> Float[np.ndarray, " d"] | None:
        """Next point (d,) in physical units after the answers: a space-filling one, else by a fit; None once all trials
        of the study are answered. `points`: renderings; `answers`: their categories (n,), from 0."""
        count = len(answers)
        if count >= self.capacity:
            return None
        if count < len(self.initial):
            return self.initial[count]
        return self._physical(self._run(points, answers)[: len(self.names)])

    def fitted(self, points: Float[np.ndarray, "n d"], answers: Any) -> Fitted:
        """Posterior after any number of answers up to the capacity, and the point that it leads to; one fit, never a
        space-filling point."""
        numbers = self._run(points, answers)
        dim = len(self.names)
        posterior = Posterior(self._study.gp, *jax.device_put(self._layout.tree(numbers[dim:])))
        point = self._physical(numbers[:dim])
        return Fitted(point, _certified(posterior) if self._study.inference == "laplace" else posterior)

    def best(self, posterior: Posterior) -> Float[np.ndarray, " d"]:
        """Optimum (d,) of a posterior of this study, for the highest response its largest mean, in physical units;
        nothing is fitted."""
        query = self._blank.copy()
        query[_GIVEN] = 1.0
        packed = jax.device_put(self._layout.vector(posterior))
        return self._physical(self._bound_to_the_best(query, packed)[: len(self.names)])

    def _physical(self, points: Any) -> Float[np.ndarray, "*n d"]:
        """Points (..., d) from a program as read-only float64, limited to the parameters' ranges: where JAX computes
        with 32 bits, its number for an end may be beyond that end."""
        numbers = np.asarray(points).astype(np.float64)
        numbers = np.where(numbers < self._low, self._low, np.where(numbers > self._high, self._high, numbers))
        numbers.flags.writeable = False
        return numbers

    def warm(self) -> None:
        """Compile the step, by running it without answers."""
        self._run(np.zeros((0, len(self.names))), ())

    def _run(self, points, answers) -> Float[np.ndarray, " k"]:
        """Run the program on the answers; return the next point and, after it, the numbers of the posterior."""
        query, count = self._blank.copy(), len(answers)
        query[_COUNT], query[_WEIGHT] = count, self.weight
        query[_FACTS : _FACTS + count] = answers
        first = _FACTS + self.capacity
        query[first : first + count * len(self.names)] = np.ravel(points)
        return np.asarray(self._bound(query, self._none_given))

    @functools.cached_property
    def _layout(self) -> "_Layout":
        """Layout of a posterior's numbers in a vector; computed once."""
        return _Layout(_posterior_shapes(self._choosing))

    @functools.cached_property
    def _none_given(self) -> Float[Array, " p"]:
        """Placeholder (zeros) where no posterior is given."""
        return jax.device_put(np.zeros(self._layout.size))

    @functools.cached_property
    def _bound(self) -> "_Bound":
        """The program of this study, with its arrays; compiled at its first use."""
        return self._bound_by(self._choosing)

    @functools.cached_property
    def _bound_to_the_best(self) -> "_Bound":
        """The program that searches the optimum of a posterior: UCB with weight 0, in most studies the same program as
        `_bound`, and the probability of a goal between other responses."""
        kind = "top_category" if self._choosing.goal.is_between else "ucb"
        plain = msgspec.structs.replace(self._choosing.selection, acquisition=kind, minimum_distance=None)
        return self._bound_by(dataclasses.replace(self._choosing, selection=plain))

    def _bound_by(self, choosing: Choosing) -> "_Bound":
        """Prepare the program for these settings, with its arrays."""
        arrays = arrays_in((choosing, self._plan))
        return _Bound(prepared(_step, choosing, self._plan, self._blank, self._none_given), arrays)


class _Bound(NamedTuple):
    """A step's program and its constant arrays, called with the two arrays that change."""

    program: OfArrays
    arrays: tuple[Array, ...]

    def __call__(self, query: Float[np.ndarray, " k"], packed: Float[Array, " p"]) -> Float[Array, " r"]:
        """Run the program on a query, and on a posterior's numbers (used only if the query says so)."""
        return self.program((*self.arrays, query, packed))


class _Query(NamedTuple):
    """Input of a step: number of answers, weight of the sd in UCB, whether a posterior is given, categories and points
    (physical units)."""

    count: Int[Array, ""]
    weight: Float[Array, ""]
    given: Bool[Array, ""]
    categories: Int[Array, " n"]
    points: Float[Array, "n d"]

    @classmethod
    def of(cls, numbers: Float[Array, " k"], capacity: int) -> "_Query":
        """Split the input vector into its parts."""
        first = _FACTS + capacity
        return cls(
            numbers[_COUNT].astype(jnp.int32),
            numbers[_WEIGHT],
            numbers[_GIVEN] > 0,
            numbers[_FACTS:first].astype(jnp.int32),
            numbers[first:].reshape(capacity, -1),
        )


class _Layout(NamedTuple):
    """Order of a posterior's trials and latent values, of these `shapes`, in a vector."""

    shapes: Any

    @property
    def size(self) -> int:
        """Length of the vector."""
        return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(self.shapes))

    def vector(self, posterior: Posterior) -> Float[np.ndarray, " p"]:
        """Pack a posterior's trials and latent values into a vector of NumPy."""
        return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves((posterior.trials, posterior.latent))])

    def tree(self, vector: Any) -> Any:
        """Unpack trials and latent values from a vector (p,) of NumPy or JAX; the inverse of `vector`."""
        leaves, structure = jax.tree.flatten(self.shapes)
        ends = np.cumsum([math.prod(leaf.shape) for leaf in leaves])
        parts = [
            vector[end - math.prod(leaf.shape) : end].reshape(leaf.shape).astype(leaf.dtype)
            for leaf, end in zip(leaves, ends.tolist(), strict=True)
        ]
        return jax.tree.unflatten(structure, parts)


def _step(
    choosing: Choosing, plan: Design, numbers: Float[Array, " k"], packed: Float[Array, " p"]
) -> Float[Array, " r"]:
    """The traced step: fit the answers in `numbers`, or take the posterior in `packed`, and choose the next point.

    Returns the point in physical units and, after it, the posterior's numbers.
    """
    query = _Query.of(numbers, choosing.selection.trials)
    layout = _Layout(_shapes(choosing))
    trials, latent = jax.lax.cond(query.given, lambda: layout.tree(packed), lambda: _fitted(choosing, query))
    point = point_after(choosing, plan, Posterior(choosing.gp, trials, latent), query.count, query.weight)
    parts = [choosing.space.to_physical(point), *jax.tree.leaves((trials, latent))]
    return jnp.concatenate([part.astype(numbers.dtype).ravel() for part in parts])


@program
def _posterior_shapes(choosing: Choosing) -> Any:
    """Shapes of trials and latent values as a step returns them; nothing is computed. It is a program so that a cached
    one makes tracing a fit unnecessary."""
    return _shapes(choosing)


def _shapes(choosing: Choosing) -> Any:
    """Shapes and dtypes of the trials and latent values of a fit, by tracing it."""
    capacity = choosing.selection.trials
    numbers = jax.ShapeDtypeStruct((_FACTS + capacity * (1 + choosing.space.dim),), jnp.result_type(float))
    shapes = jax.eval_shape(lambda given: _fitted(choosing, _Query.of(given, capacity)), numbers)
    return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), shapes)


@traced_once
def _fitted(choosing: Choosing, query: _Query):
    """Fit the answers in the query; return its trials and latent values. For Laplace the certificate is incomplete."""
    mask = jnp.arange(len(query.categories), dtype=query.count.dtype) < query.count
    trials = Trials(choosing.space.to_unit(query.points), query.categories, mask)
    posterior = fit(choosing.gp, trials, inference=choosing.inference, throw=False)
    latent = posterior.latent
    return posterior.trials, _uncertified(latent) if choosing.inference == "laplace" else latent


def _uncertified(latent: Any) -> GaussianPosterior:
    """Replace the parts of the certificate that `_certified` computes by zeros, so that they are not compiled into the
    step."""
    certificate = latent.certificate
    nothing = {name: jnp.zeros_like(getattr(certificate, name)) for name in _MADE_LATER}
    return dataclasses.replace(latent, certificate=dataclasses.replace(certificate, **nothing))


@program
def _certified(posterior: Posterior) -> Posterior:
    """Copy of a Laplace posterior with its complete certificate, computed from the fit's numbers."""
    trials, latent, likelihood = posterior.trials, posterior.latent, posterior.gp.likelihood
    terms = OrdinalTerms(likelihood, trials.q, trials.mask)
    certificate = certify(
        gram(posterior.gp.kernel, trials.x, trials.x),
        latent.mode,
        latent.weights,
        terms(latent.mode)[2],
        latent.factor,
        lambda eta: terms(eta)[2],
        latent.log_evidence,
        **{name: getattr(latent.certificate, name) for name in _FROM_THE_SEARCH},
    )
    return dataclasses.replace(posterior, latent=dataclasses.replace(latent, certificate=certificate))


@program
def _to_physical(space, unit):
    """Points of the unit cube in physical units."""
    return space.to_physical(unit)
