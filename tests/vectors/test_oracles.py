"""The stored numbers are those that their makers make."""

import numpy as np
import pytest
from oracles import oracle

from tests.vectors.make_oracles import ORACLES, leaves


@pytest.mark.deep
@pytest.mark.parametrize("name", ORACLES)
def test_what_is_stored_is_what_is_made(name):
    made, stored = dict(leaves(ORACLES[name].make())), dict(leaves(oracle(name)))
    assert made.keys() == stored.keys()
    for path, values in made.items():
        if path[-1] == ORACLES[name].sampled:
            (mean, error), (stored_mean, stored_error) = values, stored[path]
            assert np.all(np.abs(mean - stored_mean) < 4 * np.hypot(error, stored_error)), path
            np.testing.assert_allclose(error, stored_error, rtol=0.2, err_msg="/".join(path))
        else:
            np.testing.assert_allclose(
                stored[path], values, rtol=ORACLES[name].rtol, atol=ORACLES[name].atol, err_msg="/".join(path)
            )


@pytest.mark.parametrize("name", ORACLES)
def test_every_oracle_is_stored(name):
    assert all(np.all(values == values) for _, values in leaves(oracle(name)))
