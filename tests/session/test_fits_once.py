"""In a live session each (data, model) is fitted once."""

import jax
import jax.numpy as jnp
import numpy as np
from fits import count_fits

from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit, Trials, fit


def model(theta=10.0):
    return OrdinalGP(RBF(jnp.asarray(theta), jnp.asarray(1.0)), OrdinalProbit((-0.5, 0.5), noise=0.5))


def test_a_fit_counts_in_every_row_and_padding_does_not():
    x = np.linspace(0.0, 0.9, 8).reshape(4, 2)
    people = [Trials.from_arrays(x[:count], np.arange(count) % 3, 4) for count in (0, 1, 2, 3)]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *people)

    def both(gp):
        def one(person):
            return fit(gp, person, throw=False).log_evidence

        return jax.vmap(one)(stack), jax.lax.map(one, stack)

    compute = jax.jit(both)
    expected = compute(model())
    with count_fits() as fits:
        np.testing.assert_array_equal(compute(model()), expected)
        jax.effects_barrier()
        assert sorted(fits.items()) == sorted((key, 2) for key in fits)
        assert sorted(key.split(",")[0] for key in fits) == ["1 answers", "2 answers", "3 answers"]
        before = set(fits)
        fit(model(), people[2])
        compute(model(11.0))
        jax.effects_barrier()
        assert {fits[key] for key in before} == {2, 3} and len(fits) == 6
    compute(model())
    assert sum(fits.values()) == 13
