"""Makes the numbers that tests compare with and that take long to compute: high precision, quadrature, textbook loops.

    PYTHONPATH=.:tests/support python -m tests.vectors.make_oracles [NAME ...]

Each name is a file tests/vectors/NAME.json, read by `oracles.oracle`; a deep test makes all of them again and compares.
"""

import json
import sys
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from tests.vectors import evidence, exact, laplace

__all__ = ["ORACLES", "Oracle", "leaves"]


class Oracle(NamedTuple):
    """What makes a tree of numbers, and to how many digits another machine makes the same ones.

    Leaves called `sampled` are a mean and its standard error, of shape (2, n). A chain that meets another rounding
    goes another way, so these agree to their errors only.
    """

    make: Callable[[], dict]
    rtol: float
    atol: float
    sampled: str = ""


ORACLES = {
    "evidence": Oracle(evidence.make, 1e-8, 1e-8),
    "exact": Oracle(exact.make, 1e-8, 1e-10, sampled="slice_sampled"),
    "laplace_digits": Oracle(laplace.make_digits, 1e-14, 0.0),
    "laplace_slopes": Oracle(laplace.make_slopes, 1e-14, 0.0),
}


def leaves(node, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], np.ndarray]]:
    """The arrays of a tree of dictionaries, with the keys that lead to them."""
    if isinstance(node, dict):
        for key, child in node.items():
            yield from leaves(child, (*path, key))
    else:
        yield path, np.asarray(node)


def _plain(node):
    if isinstance(node, dict):
        return {key: _plain(child) for key, child in node.items()}
    return np.asarray(node).tolist()


def main() -> None:
    import jax
    from oracles import FOLDER

    jax.config.update("jax_enable_x64", True)
    for name in sys.argv[1:] or ORACLES:
        text = json.dumps(_plain(ORACLES[name].make()), indent=1)
        (FOLDER / f"{name}.json").write_text(f"{text}\n", encoding="utf-8")


if __name__ == "__main__":
    main()
