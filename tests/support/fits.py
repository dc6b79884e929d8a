"""How often each model was fitted to each data set while a program ran.

with count_fits() as fits:
    aggregate(...)
assert set(fits.values()) == {1}
"""

import contextlib
import functools
import hashlib
import threading
from collections import Counter
from collections.abc import Iterator

import jax
import numpy as np
import pytest

from hilbo import ordinal_gp

__all__ = ["count_fits"]

_DECIMALS = 9  # two programs may round the same coordinates differently


@contextlib.contextmanager
def count_fits() -> Iterator[Counter[str]]:
    """Counts the fits by `hilbo.ordinal_gp.fit` of each (data, model) that were computed in the block.

    Keys are the number of answers, the inference, and a digest of the answered points, their categories and the
    model's numbers: rows without an answer are left out, and so are fits without any answer. A fit counts whenever it
    is computed: also within `jit`, `vmap` and `lax.map`, once for each row. The counts are whole at the block's end,
    and within it after `jax.effects_barrier()`.

    What was compiled before cannot count and is compiled again; so is, after the block, what can. What a caller has
    compiled ahead of time (`jax.jit(...).lower(...).compile()`) stays as it is.
    """
    fits: Counter[str] = Counter()
    lock, solve = threading.Lock(), ordinal_gp._fit

    def record(inference, kind, model, x, q, mask):
        x, q, mask = map(np.asarray, (x, q, mask))
        if np.any(mask):
            key = _key(inference, kind, model, x[mask], q[mask])
            with lock:
                fits[key] += 1

    @functools.partial(jax.jit, static_argnames="inference")
    def counted(gp, trials, start, inference):
        kind = str(jax.tree.structure(gp))  # two kernels may have the same numbers
        leaves = jax.tree.leaves(gp)
        jax.debug.callback(functools.partial(record, inference, kind), leaves, trials.x, trials.q, trials.mask)
        return solve(gp, trials, start, inference)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ordinal_gp, "_fit", counted)
        jax.clear_caches()
        try:
            yield fits
        finally:
            jax.effects_barrier()
            jax.clear_caches()


def _key(inference, kind, model, x, q) -> str:
    digest = hashlib.sha256(kind.encode())
    for numbers in (*model, x, q):
        rounded = np.round(np.asarray(numbers, np.float64), _DECIMALS) + 0.0  # no negative zero
        digest.update(repr(rounded.shape).encode() + rounded.tobytes())
    return f"{len(q)} answers, {inference}, {digest.hexdigest()[:12]}"
