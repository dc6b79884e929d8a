"""map.nc as a warm start: what a damaged or forged one says in place of a session that begins with it."""

import random

import numpy as np
import pytest
import xarray as xr
from live import STUDY

from hilbo.errors import InputError
from hilbo.session.choose.warm_start import read_warm_start
from hilbo.study.results import map_netcdf
from hilbo.study.results.map_netcdf import map_dataset


def grid():
    def surface(x):
        x = np.asarray(x)
        return x.sum(axis=1) - 1.0, 0.1 + 0.2 * x[:, 0]

    return map_dataset(STUDY, surface, 5).assign_attrs(rule="bcm")


def test_the_grid_is_predicted_in_blocks_of_one_size(monkeypatch):
    whole, sizes = grid(), []
    monkeypatch.setattr(map_netcdf, "_BLOCK", 4)
    blocks = map_dataset(STUDY, lambda x: sizes.append(len(x)) or (x.sum(axis=1) - 1.0, 0.1 + 0.2 * x[:, 0]), 5)
    assert set(sizes) == {4} and len(sizes) == -(-whole["mean"].size // 4)
    for name in ("mean", "variance"):
        np.testing.assert_array_equal(blocks[name], whole[name])


def write(path, dataset):
    dataset.to_netcdf(path, engine="h5netcdf")
    return path


def with_number(name, value):
    made = grid()
    values = made[name].values.astype(float)
    values[0, 0] = value
    return made.assign({name: (made[name].dims, values)})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("mean", value) for value in (np.nan, 1e308, -1e5)),
        *(("variance", value) for value in (np.nan, 0.0, -3.0, 1e308, np.inf)),
    ],
)
def test_a_map_with_a_number_that_no_map_has_is_refused(tmp_path, name, value):
    with pytest.raises(InputError, match=rf"map\.nc: the map's {name}"):
        read_warm_start(write(tmp_path / "map.nc", with_number(name, value)), STUDY)


def test_a_map_of_one_point_along_a_parameter_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"map\.nc: "):
        read_warm_start(write(tmp_path / "map.nc", grid().isel(u=slice(0, 1))), STUDY)
    with pytest.raises(InputError, match=r"map\.nc: "):
        read_warm_start(write(tmp_path / "map.nc", grid().transpose("v", "u")), STUDY)


def test_a_damaged_map_is_refused_or_is_what_it_was(tmp_path):
    from hilbo.study.results.map_netcdf import write_map

    path = tmp_path / "map.nc"
    write_map(grid(), path)
    whole, content = read_warm_start(path, STUDY), path.read_bytes()
    rng, refused = random.Random(0), 0
    for _ in range(25):
        damaged = bytearray(content)
        at = rng.randrange(len(damaged))
        damaged[at] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            warm = read_warm_start(path, STUDY)
        except InputError:
            refused += 1
            continue
        np.testing.assert_array_equal(warm.mean, whole.mean)
        np.testing.assert_array_equal(warm.variance, whole.variance)
    assert 0 < refused < 25


def test_a_map_that_was_made_before_digests_were_is_read(tmp_path):
    warm = read_warm_start(write(tmp_path / "map.nc", grid()), STUDY)
    assert np.isfinite(warm.mean).all()


def test_a_map_says_what_it_said_before_it_was_written(tmp_path):
    from hilbo.study.results.map_netcdf import read_map, write_map

    write_map(grid(), tmp_path / "map.nc")
    xr.testing.assert_identical(read_map(tmp_path / "map.nc", STUDY).drop_attrs(), grid().drop_attrs())


def test_a_map_that_lost_a_dimension_is_refused(tmp_path):
    for made in (grid().isel(u=0), grid().mean("u"), grid().drop_vars("u"), grid().drop_vars("mean")):
        with pytest.raises(InputError, match=r"map\.nc: "):
            read_warm_start(write(tmp_path / "map.nc", made), STUDY)
