"""Aggregation of a population of any size: the optimum of its map, and what stands beside it, by passes over people.

The best candidates of the map are polished by Newton's method in the optimiser's coordinates. A step needs the map's
value, gradient and Hessian, which are sums over people (`batch.jets`): one pass over all of them for each step, for all
starts together. Between steps nothing is compiled and nothing is kept but the starts.

Another inference costs a fit in every pass, so its optimum is sought from where a small part of the people moves to
under it. Usually one pass is left to do, in which the whole population corrects that.
"""

import dataclasses
import functools
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, PyTree

from hilbo.errors import InputError
from hilbo.numerics.host import to_device
from hilbo.numerics.tracing import program
from hilbo.population.maps import RuleMap, learnt_map, share_of
from hilbo.population.pointwise import Sums
from hilbo.population.rules.registry import POINTWISE, RULES
from hilbo.population.shared.hierarchical import Share
from hilbo.search.apart import middle_of
from hilbo.search.candidates import search_points
from hilbo.study.cohort import Cohort
from hilbo.study.config import Study
from hilbo.study.estimate.aggregate import other_inference
from hilbo.study.estimate.batch import Jets, SayCount, StreamedCohort, jets, refit, streamed_cohort, sums
from hilbo.study.estimate.distributed import Crew
from hilbo.study.estimate.learnt import resolved
from hilbo.study.estimate.optimum import Optimum, map_optimum, predict_map

__all__ = ["LargeAggregate", "aggregate_population", "optima_from", "optimum_near"]

_STEPS = 60
_STATIONARY, _RESOLUTION = 1e-8, 1e-6  # as a session's optimum: gradient, and radius at a kink of the passive set
_STARTS, _APART = 3, 0.1
_MOST_STEPS = 20  # rounds, each of which asks all people
_PILOT, _PILOT_SHARE = 1000, 20  # people asked first by another inference: so many, or this part of all,
_FEWEST = 50  # and nobody if that is too few
_SETTLED = 0.003  # of the search ranges: a Newton step of this size leaves an error of its square over a lengthscale


class LargeAggregate(eqx.Module):
    """What `aggregate.Aggregate` is for a cohort whose posteriors are not kept."""

    study: Study
    """With the model that the answers say, where its rule learns."""
    cohort: Cohort
    population: StreamedCohort
    certificates: dict[str, np.ndarray]
    optimum: Optimum
    individuals: Optimum | None
    """Stacked; None if they were not asked for."""
    alternatives: dict[str, Optimum]
    share: Share | None = None
    """What the answers of an even choice of people say of how people differ, where the rule asks for it."""
    map: RuleMap | None = None
    """Of a rule that takes all answers at once; the maps of others are sums over people."""
    hierarchical: None = None

    def surface(self, x: Float[np.ndarray, "m d"]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Mean and variance (m,) of the population map at points of the unit cube; of a map that is a sum over people
        by a pass of the whole crew."""
        if self.map is not None:
            mean, variance = predict_map(self.map, to_device(x))
            return np.asarray(mean), np.asarray(variance)
        study = self.population.study
        prior = np.asarray(jax.vmap(study.gp.kernel.diagonal)(jnp.asarray(x)))
        return sums(self.population, x, "participants asked for the map").merge(
            prior, self.population.people, self.population.rule, self.population.share
        )

    @property
    def mean_of_optima(self) -> Float[Array, " d"] | None:
        """Plain average of the individuals' optima in the unit cube, of levels the commonest, if they are known."""
        if self.individuals is None:
            return None
        levels = self.population.study.gp.kernel.levels
        return to_device(middle_of(levels, np.asarray(self.individuals.x)))


def aggregate_population(
    study: Study,
    cohort: Cohort,
    crew: Crew,
    seed: int = 0,
    *,
    individuals: bool = True,
    alternatives: bool = True,
    say: SayCount | None = None,
) -> LargeAggregate:
    """As `aggregate.aggregate_cohort`, in bounded memory and by all devices of the crew.

    Without `individuals` nobody's own optimum is sought, which is most of the work. One model of all answers is no
    alternative here: its cost is cubic in their number. A rule that learns does so from all answers, at a cost that is
    linear in people, in each process by itself.
    """
    candidates = np.asarray(search_points(study.space, seed))
    if RULES[study.rule].learns:
        return _that_learns(resolved(study, cohort), cohort, crew, candidates, individuals, alternatives, say)
    rule = _streamed(study.rule, len(cohort.names))
    share = share_of(study.gp, cohort.trials, study.inference) if RULES[rule].learns_share else None
    population = streamed_cohort(study, cohort, crew) if say is None else streamed_cohort(study, cohort, crew, say)
    population = dataclasses.replace(population, rule=rule, share=1.0 if share is None else float(share.mean))
    fitted = refit(population, candidates, individuals)
    rules: tuple[str, ...] = tuple(dict.fromkeys((rule, "average"))) if alternatives else (rule,)
    best = optima_from(fitted.population, candidates, fitted.sums, rules)
    others = {name: best[name] for name in rules if name != rule}
    if alternatives:
        others[other_inference(study)] = _by_other_inference(fitted.population, best[rule])
    optimum = best[rule]
    return LargeAggregate(
        study, cohort, fitted.population, fitted.certificate, optimum, fitted.individuals, others, share
    )


def _that_learns(
    study: Study,
    cohort: Cohort,
    crew: Crew,
    candidates: Float[np.ndarray, "m d"],
    individuals: bool,
    alternatives: bool,
    say: SayCount | None,
) -> LargeAggregate:
    """By a rule that has learnt the hyperparameters: the map from all answers at once, everybody's own optimum and the
    other rules beside it by passes over people."""
    assert study.learnt is not None
    map_ = learnt_map(study.learnt, cohort.trials)
    optimum = map_optimum(study, map_, to_device(candidates))
    people = dataclasses.replace(study, learnt=None)  # of which each program needs the model alone
    population = streamed_cohort(people, cohort, crew) if say is None else streamed_cohort(people, cohort, crew, say)
    fitted = refit(population, candidates, individuals)
    rules: tuple[str, ...] = ("bcm", "average") if alternatives else ()
    others = optima_from(fitted.population, candidates, fitted.sums, rules) if rules else {}
    return LargeAggregate(
        study, cohort, fitted.population, fitted.certificate, optimum, fitted.individuals, others, map=map_
    )


def _streamed(rule: str, people: int) -> str:
    """A rule that is a sum over people, as a stream of them needs it."""
    if rule not in POINTWISE:
        raise InputError(
            f'The rule "{rule}" takes all answers at once, on one device, not in a stream of {people:,} people;'
            f" use {', '.join(POINTWISE[:-1])} or {POINTWISE[-1]}."
        )
    return rule


def optima_from(
    population: StreamedCohort, candidates: Float[np.ndarray, "m d"], totals: Sums, rules: tuple[str, ...] = ("bcm",)
) -> dict[str, Optimum]:
    """The maximum of the map by each rule in the feasible set, from the sums at candidates (m, d)."""
    prior = np.asarray(jax.vmap(population.study.gp.kernel.diagonal)(jnp.asarray(candidates)))
    maps = {rule: totals.merge(prior, population.people, rule, population.share) for rule in rules}
    rows = {rule: _separate_rows(maps[rule][0], candidates) for rule in rules}
    starts = np.concatenate([candidates[rows[rule]] for rule in rules])
    reached = optimum_near(population, starts, tuple(rule for rule in rules for _ in range(_STARTS)))
    feasible = np.asarray(_feasible(population.study, np.stack([optimum.x for optimum in reached])))
    best = {}
    for i, rule in enumerate(rules):
        chosen = slice(i * _STARTS, (i + 1) * _STARTS)
        usable = [optimum for optimum, allowed in zip(reached[chosen], feasible[chosen], strict=True) if allowed]
        top = rows[rule][0]
        mean, variance = (moment[top] for moment in maps[rule])
        candidate = _optimum_at(
            population.study, candidates[top], mean, variance, _variance_apart(population.study, rule, population.share)
        )
        best[rule] = _by_steps(population, max([candidate, *usable], key=_height), rule)
    return best


def _height(optimum: Optimum) -> float:
    return float(optimum.mean)


def _by_steps(population: StreamedCohort, best: Optimum, rule: str) -> Optimum:
    """From an optimum the highest of those a step of whole numbers or levels away, polished, until none is higher."""
    study, neighbours = population.study, population.study.space.searched.get("neighbours")
    if neighbours is None:
        return best
    for _ in range(_MOST_STEPS):
        near = np.asarray(neighbours(jnp.asarray(best.x)))
        prior = np.asarray(jax.vmap(study.gp.kernel.diagonal)(jnp.asarray(near)))
        totals = sums(population, near, "participants, trying steps nearby")
        mean, variance = totals.merge(prior, population.people, rule, population.share)
        top = int(np.argmax(np.where(np.asarray(_feasible(study, near)), mean, -np.inf)))
        if mean[top] <= best.mean:
            break
        apart = _variance_apart(study, rule, population.share)
        step = _optimum_at(study, near[top], mean[top], variance[top], apart)
        (polished,) = optimum_near(population, near[top : top + 1], (rule,))
        allowed = bool(np.asarray(_feasible(study, np.asarray(polished.x)[None, :]))[0])
        best = max([step, polished] if allowed else [step], key=_height)
    return best


@program
def _feasible(study: Study, x: Float[ArrayLike, "s d"]) -> Bool[Array, " s"]:
    return study.space.feasible(x)


@program
def _optimum_at(
    study: Study,
    x: Float[ArrayLike, " d"],
    mean: Float[ArrayLike, ""],
    variance: Float[ArrayLike, ""],
    apart: Float[ArrayLike, ""],
) -> Optimum:
    mean, variance = jnp.asarray(mean), jnp.asarray(variance)
    chances = study.gp.likelihood.class_probabilities(mean, variance + apart)
    return Optimum(jnp.asarray(x), mean, jnp.sqrt(variance), chances)


def _variance_apart(study: Study, rule: str, share: float) -> ArrayLike:
    """Variance of one person's function about the map's, as `RuleMap.apart`."""
    prior = np.asarray(study.gp.kernel.variance)
    return prior * np.asarray(1.0 - share if RULES[rule].learns_share else 0.0, prior.dtype)


def _separate_rows(values: Float[np.ndarray, " m"], candidates: Float[np.ndarray, "m d"]) -> list[int]:
    """Rows of good candidates from different places: the best, the best apart from it, and so on."""
    rows, remaining = [], values.copy()
    for _ in range(_STARTS):
        rows.append(int(np.argmax(remaining)))
        near = np.sum((candidates - candidates[rows[-1]]) ** 2, axis=1) < _APART**2
        remaining[near] = -np.inf
    return rows


def _by_other_inference(population: StreamedCohort, best: Optimum) -> Optimum:
    """The optimum nearby under the other inference."""
    study, starts = population.study, np.asarray(best.x)[None, :]
    other = other_inference(study)
    pilot = population.every(min(_PILOT, population.people // _PILOT_SHARE))
    if pilot.people >= _FEWEST:
        (pilot_optimum,), (pilot_other,) = (
            optimum_near(p, starts, (population.rule,)) for p in (pilot, pilot.by(other))
        )
        box = study.space.to_box
        shifted = jnp.clip(box(best.x) + box(pilot_other.x) - box(pilot_optimum.x), 0.0, 1.0)
        starts = np.asarray(study.space.from_box(shifted))[None, :]
    name = {"ep": "expectation propagation", "laplace": "Laplace"}[other]
    words = f"participants fitted by {name} for comparison"
    return optimum_near(population.by(other), starts, (population.rule,), tolerance=_SETTLED, words=words)[0]


def optimum_near(
    population: StreamedCohort,
    starts: Float[np.ndarray, "s d"],
    rules: tuple[str, ...],
    *,
    tolerance: float = 0.0,
    words: str = "participants, polishing the optimum",
) -> list[Optimum]:
    """For each start, the maximum of the map by its rule that Newton's method finds from there, in the feasible set.

    Ends when every start is stationary, or would move by `tolerance` of the search ranges or less; the step is then
    taken, and the map there read off the last expansion.
    """
    study, count = population.study, len(rules)
    slots = _STARTS * -(-count // _STARTS)  # few shapes, few compilations
    rows = np.arange(slots) % count
    plain = np.array([not RULES[rule].weighted for rule in rules])[rows]
    by: tuple[str, float] = population.rule, population.share
    w, state = _start_newton(study, np.asarray(starts)[rows])
    for _ in range(_STEPS):
        points = _next_points(study, w, state)
        expansions = jets(population, np.asarray(points), words)
        people = jnp.asarray(float(population.people))
        w, state, finished, last = _newton_step(study, w, state, expansions, points, plain, people, by)
        if bool(jnp.all(finished | (jnp.max(jnp.abs(state.move), axis=1) <= tolerance))):
            break
    x, mean, variance = last if tolerance else state.here.aux
    return [
        _optimum_at(
            study, jnp.clip(x[i], 0.0, 1.0), mean[i], variance[i], _variance_apart(study, rules[i], population.share)
        )
        for i in range(count)
    ]


@functools.cache
def _solver() -> Any:
    """Newton's method in the feasible set, a `TrustRegionNewton`."""
    from hilbo.numerics.newton import TrustRegionNewton  # slow to import, and needed only where a step is traced

    return TrustRegionNewton(atol=_STATIONARY, resolution=_RESOLUTION)


def _nowhere(w: Float[Array, " d"], _: None) -> NoReturn:
    """The solver does not look at its function before the first step."""
    raise NotImplementedError


@program
def _start_newton(study: Study, starts: Float[ArrayLike, "s d"]) -> tuple[Float[Array, "s d"], PyTree]:
    """Each start in the optimiser's coordinates, and the solver's state there."""

    def one(x):
        w = study.space.to_box(x)
        number = jax.ShapeDtypeStruct((), w.dtype)
        aux = (jax.ShapeDtypeStruct(w.shape, w.dtype), number, number)
        return w, _solver().init(_nowhere, w, None, {}, number, aux, frozenset())

    return jax.vmap(one)(jnp.asarray(starts))


@program
def _next_points(study: Study, w: Float[Array, "s d"], state: PyTree) -> Float[Array, "s d"]:
    """The points (s, d) of the unit cube at which the next step wants the map."""
    return jax.vmap(study.space.from_box)(w + state.move)


@program
def _newton_step(
    study: Study,
    w: Float[Array, "s d"],
    state: PyTree,
    jets: Jets,
    points: Float[Array, "s d"],
    plain: Bool[ArrayLike, " s"],
    people: Float[Array, ""],
    by: tuple[str, float],
) -> tuple[
    Float[Array, "s d"], PyTree, Bool[Array, " s"], tuple[Float[Array, "s d"], Float[Array, " s"], Float[Array, " s"]]
]:
    """A step of the solver, whose function is the map expanded at the point it asks for."""
    searched = study.space.searched
    bounds: dict[str, Any] = {key: searched[key] for key in ("walls", "held") if key in searched}
    bounds |= {"lower": jnp.zeros(w.shape[1:], w.dtype), "upper": jnp.ones(w.shape[1:], w.dtype)}

    def one(w, state, jets, point, plain):
        def expanded(w, _):
            x = study.space.from_box(w)
            off, prior = x - point, study.gp.kernel.diagonal(x)
            expanded_sums = jax.tree.map(lambda v, g, h: v + g @ off + 0.5 * off @ h @ off, *jets)
            mean, variance = (
                jnp.where(plain, *both)
                for both in zip(
                    expanded_sums.merge(prior, people, "average"), expanded_sums.merge(prior, people, *by), strict=True
                )
            )
            return -mean, (x, mean, variance)

        w, state, _ = _solver().step(expanded, w, None, bounds, state, frozenset())
        done, _ = _solver().terminate(expanded, w, None, bounds, state, frozenset())
        return w, state, done, expanded(w + state.move, None)[1]

    return jax.vmap(one)(w, state, Jets(*jets), points, plain)
