"""In a live session each (data, model) is fitted once."""

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
from fits import count_fits
from live import STUDY, beginning, header

from hilbo.app.pages.slices import Maps
from hilbo.ordinal_gp import RBF, OrdinalGP, OrdinalProbit, Trials, fit
from hilbo.session.choose.look_ahead import LiveChooser
from hilbo.session.log import actions as live
from hilbo.session.log.state import LiveSession
from hilbo.study.file.plan_file import Block

pytestmark = pytest.mark.empties_caches


def model(theta=10.0):
    return OrdinalGP(RBF(jnp.asarray(theta), jnp.asarray(1.0)), OrdinalProbit((-0.5, 0.5), noise=0.5))


@pytest.mark.deep  # 5 s
def test_a_fit_counts_in_every_row_and_padding_does_not():
    x = np.linspace(0.0, 0.9, 8).reshape(4, 2)
    people = [Trials.from_arrays(x[:count], np.arange(count) % 3, 4) for count in (0, 1, 2, 3)]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *people)

    def both(gp):
        def one(person):
            return fit(gp, person, throw=False).log_evidence

        return jax.vmap(one)(stack), jax.lax.map(one, stack)

    compute = jax.jit(both)
    with count_fits() as fits:
        compute(model())
        jax.effects_barrier()
        assert sorted(fits.items()) == sorted((key, 2) for key in fits)
        assert sorted(key.split(",")[0] for key in fits) == ["1 answers", "2 answers", "3 answers"]
        before = set(fits)
        fit(model(), people[2])
        compute(model(11.0))
        jax.effects_barrier()
        assert {fits[key] for key in before} == {2, 3} and len(fits) == 6
    assert sum(fits.values()) == 13


def test_a_live_trial_fits_each_data_set_once():
    """Look-ahead, answer, explanation, slices and trust; from the space-filling trials on, with a repeat and voids."""
    state = LiveSession.start(
        STUDY.file, msgspec.structs.replace(header(), blocks=(Block("optimisation", 6),), sets={})
    )
    with count_fits() as fits:
        chooser = LiveChooser(state)
        maps = Maps(chooser)
        chooser.warm()
        maps.warm()

        def trial(state):
            """A rendering is proposed and felt, the next is sought, and the experimenter looks."""
            state = state.after(live.propose(state, chooser, 0.0))
            for step in range(len(state.steps_of(state.pending))):
                for event in beginning(state, state.pending.id, step, 0.0):
                    state = state.after(event)
            chooser.lookahead(state)
            look(state)
            return state

        given = []

        def look(state):
            assert bool(maps.slices(state)["slices"]) == bool(given)  # nothing is shown before there is an answer
            assert bool(maps.trust(state)) == bool(given)

        def answered(state, response):
            values = {"class_a": response}
            given.append(response)
            state = state.after(live.answer(state, state.pending.id, f"c{state.seq}", values, 0.0))
            look(state)
            return state

        for response in ("similar", "different", "close"):  # two of them space-filling
            state = answered(trial(state), response)
        for _ in range(2):  # the device stops twice: another rendering takes its place
            state = trial(state)
            state = state.after(live.device(state, "hold", 0.0))
        state = answered(trial(state), "close")
        state = state.after(live.repeat(state, 0.0, 3))
        state = answered(trial(state), "similar")  # the answer to a repeat is no data
        for response in ("different", "close"):
            state = answered(trial(state), response)
        assert state.screen == "done"
    # Seven renderings, three answers to each; before the first there is a fit without answers, which is not counted.
    assert len(fits) == 21
    assert set(fits.values()) == {1}
    assert chooser.fits == 22
