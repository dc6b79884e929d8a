"""Calls have the same words if and only if they are the same program."""

import dataclasses
import enum
import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from hilbo.programs.description import NotKeptError, describe
from hilbo.study.config import Study


class Colour(enum.Enum):
    RED = 1
    BLUE = 2


class Part(eqx.Module):
    a: object
    b: object = eqx.field(static=True, default=1)


@dataclasses.dataclass(frozen=True)
class Record:
    a: object


def one(x):
    return x


def two(x):
    return x


def words(*args, function=one, **kwargs):
    return describe(function, args, kwargs)


DIFFERENT = {
    "function": [words(1.0), words(1.0, function=two)],
    "value": [words(1), words(2), words(True), words(1.0), words("1"), words(None), words(b"1"), words(np.float64(1))],
    "shape": [words(jnp.ones(2)), words(jnp.ones((2, 1))), words(jnp.ones((1, 2)))],
    "type": [words(jnp.ones(2, t)) for t in (jnp.float64, jnp.float32, jnp.int32, bool)],
    "weakness": [words(jnp.asarray(1.0)), words(jnp.asarray(np.float64(1.0)))],
    "NumPy's": [words(np.ones(2)), words(jnp.ones(2))],
    "tree": [words((1, 2)), words([1, 2]), words(1, 2), words((1,), 2), words({"a": 1}), words(a=1), words(b=1)],
    "nested": [words(((1, 2), 3)), words((1, (2, 3))), words((1, 2, 3))],
    "member": [words(Colour.RED), words(Colour.BLUE), words(1)],
    "class": [words(Part(1)), words(Record(1)), words(Part(1, 2)), words(Part(2))],
    "function as argument": [words(one), words(two), *(words(functools.partial(one, n)) for n in (1, 2))],
    "bits of a float": [words(0.1 + 0.2), words(0.3), words(0.0), words(-0.0), words(float("nan"))],
    "words in words": [words("a:1 b"), words("a", "1 b"), words("a", 1, "b")],
}


@pytest.mark.parametrize("what", DIFFERENT)
def test_what_differs_has_other_words(what):
    assert len(set(DIFFERENT[what])) == len(DIFFERENT[what])


def test_values_of_arrays_have_no_words():
    assert words(jnp.ones(2)) == words(jnp.zeros(2))
    assert words(Part(jnp.ones(2))) == words(Part(jnp.zeros(2)))


@pytest.mark.parametrize(
    "what",
    [
        *(lambda x: x, Record(jnp.ones(2)), Record([np.ones(2)]), Part(1, Record(np.ones(1))), object()),
        *(functools.partial(one, jnp.ones(2)), one.__get__(1), {1, 2}),
    ],
)
def test_what_cannot_be_told_in_words_is_not_kept(what):
    with pytest.raises(NotKeptError):
        words(what)


def test_a_function_that_is_no_longer_found_by_its_name_is_not_kept():
    def inner(x):
        return x

    with pytest.raises(NotKeptError, match="inner"):
        words(1, function=inner)


def test_words_of_the_shipped_study_hold_its_numbers():
    study = Study.load("hilbo/data/paper.toml")
    assert words(study.space) != words(study.gp)
    assert str(study.space.mechanics.N) in words(study.space)
