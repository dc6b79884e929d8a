"""The responses of a study's participants, padded to one capacity: conversion of a trial table to the arrays that a
batched fit takes."""

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax.typing import ArrayLike
from jaxtyping import Array, Float, Int

from hilbo.errors import InputError, warn_caller
from hilbo.numerics.host import to_device
from hilbo.numerics.rows import rows_of
from hilbo.numerics.shown import has_values
from hilbo.numerics.tracing import program
from hilbo.ordinal_gp import Trials
from hilbo.population.rules.registry import RULES
from hilbo.search.space import SearchSpace
from hilbo.study.config import Study
from hilbo.study.formats.csv_file import FRAME, cell_pieces, cells_of
from hilbo.study.importing.export import import_files
from hilbo.study.importing.mapping import mapping_of, read_mapping
from hilbo.study.tables.trials import TrialTable, check_recoding, trial_table

__all__ = ["Cohort", "cohort_of", "read_trials"]

_LEVELS = 200  # of a random effect
_CATEGORIES = "hilbo's column category"
"""Attribute of a DataFrame whose column `category` was added by `read_trials`."""


class Cohort(eqx.Module):
    """The responses of M participants, padded to one capacity (the number of slots per participant).

    `trials` is stacked, (M, capacity, ...), with a mask of the slots in use; `physical` (M, capacity, d) has the same
    points in physical units (levels by index), NaN in unused slots. `names`: participants' ids.
    """

    trials: Trials
    physical: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    contexts: tuple[str, ...] = eqx.field(static=True, default=())
    """Levels of the study's random effect, in the order of `trials.context`."""
    numbers: np.ndarray | None = None
    """Trial number of each response in the table (M, capacity), 0 in unused slots; None without a table."""
    session: np.ndarray | None = None
    """Index in `sessions` of each response's session (M, capacity); None if the table has no such column."""
    sessions: tuple[str, ...] = eqx.field(static=True, default=())
    """Names of the sessions."""

    def __repr__(self) -> str:
        """Counts of participants, responses and parameters, with the first six ids; the field structure while JAX
        traces."""
        if not has_values(self.trials.x, self.trials.mask):
            return eqx.tree_pformat(self)
        few = ", ".join(self.names[:6]) + (", ..." if len(self.names) > 6 else "")
        answers, dim = int(np.sum(self.trials.mask)), self.trials.x.shape[-1]
        return f"Cohort({len(self.names)} participants ({few}), {answers} answers, {dim} parameters)"

    def first(self, count: int) -> "Cohort":
        """Copy of the cohort in which only each participant's first `count` responses are unmasked; capacity and
        `physical` are unchanged. Raises `InputError` for fewer than one."""
        if count < 1:
            raise InputError(f"Cohort: first is {count}; give a number of trials from 1.")
        mask = np.asarray(self.trials.mask) & (np.arange(self.trials.mask.shape[1]) < count)[None, :]
        return dataclasses.replace(self, trials=eqx.tree_at(lambda t: t.mask, self.trials, to_device(mask)))

    def of(self, names: Sequence[str]) -> "Cohort":
        """Sub-cohort of these participants (ids, or one id), in the order given. Raises `InputError` for an id that is
        not in the cohort, or given twice."""
        names = [names] if isinstance(names, str) else list(names)
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f'participant "{twice}" is named twice; name each person once.')
        present = set(self.names)
        unknown = [name for name in names if name not in present]
        if unknown:
            raise InputError(
                f'participant "{unknown[0]}" is not in the table, which has {len(self.names)} participants.'
            )
        places = {name: row for row, name in enumerate(self.names)}
        return self.rows(np.array([places[name] for name in names]))

    def rows(self, rows: Int[np.ndarray, " k"]) -> "Cohort":
        """Sub-cohort by row. `rows` (k,): row numbers from 0, in the order wanted."""
        names = tuple(self.names[row] for row in rows)
        numbers, session = (None if held is None else held[rows] for held in (self.numbers, self.session))
        of_rows = rows_of(self.trials, rows), self.physical[rows], names
        return Cohort(*of_rows, self.contexts, numbers, session, self.sessions)

    def counts(self) -> Int[np.ndarray, " M"]:
        """Number of unmasked responses of each participant. (M,)."""
        return np.asarray(self.trials.mask).sum(axis=1)


def read_trials(
    path: str | os.PathLike,
    study: Study,
    material: str | None = None,
    *,
    mapping: str | os.PathLike | Mapping[str, object] | None = None,
    others: bool = True,
    say: Callable[[int], None] = lambda rows: None,
    note: Callable[[str], object] = warn_caller,
) -> pd.DataFrame:
    """Read and check a trial table; returns the rows to be fitted, sorted by participant, session and trial.

    Adds the column `category` (0 = lowest response); a parameter with levels gets the index of the level (from 0) in
    place of its name. Warm-up, repeated and voided rows, and those with a flag that the study excludes, are checked and
    left out.

    **Arguments:** `path`: a CSV or Parquet file. `material`: select its rows; required if the table has several.
    `mapping`: the mapping file of `hilbo import`, or its content, by which another program's export is converted first.
    `others`: keep the columns that hilbo does not use. `say`: called with the number of rows read so far. `note`:
    called with one sentence on each of: participants none of whose responses is fitted, two ids that may be one
    participant's, ids that a spreadsheet has rounded, missing responses; by default a warning. Raises `InputError`.
    """
    cells = cell_pieces(path) if mapping is None else [_converted(path, study, mapping, note)]
    table = trial_table(cells, study.file, material, source=str(path), others=others, say=say, note=note)
    table.rows.attrs[_CATEGORIES] = True
    return table.rows


def _converted(
    path: str | os.PathLike,
    study: Study,
    mapping: str | os.PathLike | Mapping[str, object],
    note: Callable[[str], object],
) -> pd.DataFrame:
    """The trial table of an export as text cells, its rows numbered from 1. Raises `InputError`."""
    given = mapping_of(mapping, "mapping") if isinstance(mapping, Mapping) else read_mapping(Path(mapping))
    made, _ = import_files([Path(path)], study.file, given, note=note)
    return cells_of(made.table)


def cohort_of(table: TrialTable | pd.DataFrame, study: Study, capacity: int | None = None) -> Cohort:
    """The cohort of a trial table: a checked `TrialTable`, or a DataFrame with the columns of a trial table, such as
    `read_trials` returns, which is checked as a file is.

    `capacity` defaults to the study's number of trials, or to the most responses of a participant if that is more.
    Raises `InputError` for an invalid table, and for a `capacity` smaller than a participant's number of responses.
    """
    answers = (table if isinstance(table, TrialTable) else _checked(table, study)).rows
    person, names = pd.factorize(answers["participant"])
    counts = np.bincount(person)
    longest = int(counts.max())
    capacity = max(longest, study.file.selection.trials) if capacity is None else capacity
    if capacity < longest:
        raise InputError(f"cohort_of: capacity is {capacity}, but {longest} answers of a participant need as many.")
    order = np.argsort(person, kind="stable")
    rank = np.arange(len(person)) - np.repeat(np.cumsum(counts) - counts, counts)
    rows = person[order], rank
    physical = np.full((len(counts), capacity, study.space.dim), np.nan)
    physical[rows] = answers[list(study.space.names)].to_numpy(float)[order]
    categories = np.zeros((len(counts), capacity), np.int32)
    categories[rows] = answers["category"].to_numpy()[order]
    held = np.arange(capacity)[None, :] < counts[:, None]
    middle = [p.middle for p in study.space.parameters]
    x = _to_unit(study.space, np.where(held[..., None], physical, middle))
    asked = _numbers_and_sessions(answers.iloc[order], rows, held.shape)
    texts = _random_effect(answers, study)
    if texts is None:
        return Cohort(jax.vmap(Trials)(x, to_device(categories), to_device(held)), physical, tuple(names), (), *asked)
    levels, contexts = pd.factorize(texts, sort=True)
    context = np.zeros((len(counts), capacity), np.int32)
    context[rows] = levels[order]
    trials = jax.vmap(Trials)(x, to_device(categories), to_device(held), to_device(context))
    return Cohort(trials, physical, tuple(names), tuple(contexts), *asked)


def _numbers_and_sessions(
    table: pd.DataFrame, rows: tuple[np.ndarray, np.ndarray], shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray | None, tuple[str, ...]]:
    """Arrays of trial numbers and session indices, both of `shape` (0 in unused slots), and the session names in index
    order.

    `rows`: participant index and slot of each row of `table`. Without a column "session": None and ().
    """
    numbers, session = np.zeros(shape, np.int64), np.zeros(shape, np.int32)
    numbers[rows] = table["trial"].to_numpy(int)
    if "session" not in table:
        return numbers, None, ()
    session[rows], sessions = pd.factorize(table["session"].fillna("").astype(str))
    return numbers, session, tuple(sessions)


def _checked(table: pd.DataFrame, study: Study) -> TrialTable:
    """Convert a DataFrame to text cells and check it as a file is. Two columns that `read_trials` makes are converted
    back: level indices become level names, and `category` gives the response where that column is missing. If
    `read_trials` made the table and it has both, they must agree. Raises InputError."""
    text = cells_of(table)
    _note_order(table, study.responses)
    for p in study.space.parameters:
        if p.levels and p.name in table and pd.api.types.is_numeric_dtype(table[p.name]):
            names = table[p.name].map(dict(enumerate(p.levels)))
            text[p.name] = text[p.name].mask(names.notna().to_numpy(), names.to_numpy())
    if "response" not in table and "category" in table and pd.api.types.is_integer_dtype(table["category"]):
        responses = table["category"].map(dict(enumerate(study.responses)))
        if responses.notna().all():  # a number beyond them may look like a rank
            text["response"] = responses.to_numpy()
    elif _CATEGORIES in table.attrs and {"response", "category"} <= set(text.columns):
        check_recoding(text, study.responses)
    return trial_table([text], study.file, source=FRAME)


def _note_order(table: pd.DataFrame, responses: Sequence[str]) -> None:
    """Warn if the responses are an ordered categorical whose order contradicts the study's."""
    if "response" not in table or not isinstance(table["response"].dtype, pd.CategoricalDtype):
        return
    kind = table["response"].cat
    if not kind.ordered:
        return
    categories = [str(label) for label in kind.categories]
    known = [label for label in categories if label in responses]
    if known != [label for label in responses if label in known]:
        warn_caller(
            f"{FRAME}: response is ordered {' < '.join(known)}; the study's order {' < '.join(responses)} is used."
        )


def _random_effect(table: pd.DataFrame, study: Study) -> np.ndarray | None:
    """Text of each row in the column of the study's random effect, (n,); None if the study specifies none, if all rows
    have one level, or if the column is missing and the method does not learn the effect. Raises InputError if the
    column is missing with a method that does, or if there are more than 200 levels."""
    column = study.file.random_effect
    if column is None or (column not in table and not RULES[study.rule].learns):
        return None
    if column not in table:
        raise InputError(
            f'the table has no column "{column}", which [random_effect] names: add it (hilbo export writes the table'
            " of sessions), or leave [random_effect] out."
        )
    texts = table[column].astype(str).str.strip()
    count = texts.nunique()
    if count > _LEVELS:
        raise InputError(
            f'column "{column}" has {count:,} different texts; a random effect takes up to {_LEVELS}, such as clips or'
            " days; leave [random_effect] out."
        )
    return texts.to_numpy(object) if count > 1 else None


@program
def _to_unit(space: SearchSpace, physical: Float[ArrayLike, "M n d"]) -> Float[Array, "M n d"]:
    """Physical values mapped to the unit cube, participant by participant; bit-identical to
    `session.ask_tell.physical_trials`."""
    return jax.lax.map(space.to_unit, jnp.asarray(physical))
