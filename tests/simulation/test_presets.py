"""The populations that `--preset` names."""

import pytest

from hilbo.errors import InputError
from hilbo.simulation.presets import PRESETS, preset_of

THIRTY = [f"paper-{k:02d}" for k in range(1, 31)]


def test_there_are_thirty_and_what_came_before():
    assert set(PRESETS) == {"paper", "paper-individuals", *THIRTY}
    assert PRESETS["paper"] in [PRESETS[name] for name in THIRTY]


@pytest.mark.parametrize("name", ["paper-individuals", *THIRTY])
def test_each_is_a_population(name):
    p = PRESETS[name]
    assert set(p.truth) == {"K1", "B1", "alpha"} and len(p.spread) == len(p.tolerance) == 3
    assert all(0 < value < 1 for value in (*p.spread, *p.tolerance))
    assert p.criteria[0] > p.criteria[1] == 1.0
    assert 0 <= p.lapse < 0.2 and 0 < p.noise < 2 and 0 <= p.contrast <= 1


def test_an_unknown_name_is_one_sentence():
    with pytest.raises(InputError, match='--preset is "papr"; there are paper, paper-individuals, paper-01'):
        preset_of("papr")
