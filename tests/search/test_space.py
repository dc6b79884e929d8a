"""The search space: exact scales, the passive box, and points that fill it evenly."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import qmc

from hilbo import passivity, viscoelastic
from hilbo.errors import InputError
from hilbo.search.box import Mechanics, Parameter
from hilbo.search.feasibility import SEARCH_MARGIN
from hilbo.search.rendering import delay_words
from hilbo.search.space import SearchSpace

K1 = Parameter("K1", 1.0, 32.0, "N/mm")
B1 = Parameter("B1", 0.001, 32.0, "N.s^alpha/mm")
ALPHA = Parameter("alpha", 0.01, 0.99)
PAPER = Mechanics(K_eff=0.44, damping=0.95)
PLAIN = SearchSpace(
    (Parameter("bitrate", 100.0, 20000.0, "kbit/s", "log"), Parameter("height", 144.0, 2160.0, "px", "log"))
)
ORDERS = {"usual": (K1, B1, ALPHA), "other": (ALPHA, Parameter("friction", 0.0, 1.0), K1, B1)}
DRAWN = 20_000  # points, everywhere: each count is a program of its own
units = st.floats(0, 1, allow_subnormal=False)  # XLA flushes these to 0


def _deep(*cases):
    """These cases of a test in deep runs only."""
    return [pytest.param(*case, marks=pytest.mark.deep) for case in cases]


@functools.cache
def fosls(damping=0.95, order="usual", **mechanics):
    return SearchSpace(ORDERS[order], Mechanics(K_eff=0.44, damping=damping, **mechanics))


@functools.cache
def compiled(space):
    """Its `from_box`, `to_box`, `feasible` and `to_physical` as one program each."""
    return SimpleNamespace(
        **{name: jax.jit(getattr(space, name)) for name in ("from_box", "to_box", "feasible", "to_physical")}
    )


def test_columns_are_named_in_order():
    assert fosls(order="other").names == ("alpha", "friction", "K1", "B1")
    assert fosls(order="other").dim == 4


@settings(deadline=None)
@given(st.floats(-1e6, 1e6, allow_subnormal=False), st.floats(1e-6, 1e6), units)
def test_linear_scale_meets_both_ends_and_stays_between(low, width, unit):
    p = Parameter("p", low, low + width)
    ends = jnp.array([p.low, p.high])
    np.testing.assert_array_equal(p.to_unit(ends), [0, 1])
    np.testing.assert_array_equal(p.to_physical(jnp.array([0.0, 1.0])), ends)
    value = p.to_physical(jnp.asarray(unit))
    assert p.low <= value <= p.high
    assert 0 <= p.to_unit(value) <= 1
    assert p.to_unit(value) == pytest.approx(unit, abs=4e-16 * (1 + (abs(low) + width) / width))


@settings(deadline=None)
@given(st.floats(1e-6, 1e3), st.floats(1.01, 1e6), units)
def test_log_scale_meets_both_ends_and_stays_between(low, ratio, unit):
    p = Parameter("p", low, low * ratio, scale="log")
    ends = jnp.array([p.low, p.high])
    np.testing.assert_array_equal(p.to_unit(ends), [0, 1])
    np.testing.assert_array_equal(p.to_physical(jnp.array([0.0, 1.0])), ends)
    value = p.to_physical(jnp.asarray(unit))
    assert p.low <= value <= p.high
    assert p.to_unit(value) == pytest.approx(unit, abs=1e-15 * (1 + 1 / np.log(ratio)))


def test_log_scale_has_its_geometric_mean_in_the_middle():
    np.testing.assert_allclose(PLAIN.to_physical(jnp.array([0.5, 0.5])), np.sqrt([100 * 20000, 144 * 2160]))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("space", [PLAIN, SearchSpace((K1, B1, ALPHA))], ids=["log", "linear"])
def test_the_cube_meets_its_ends_in_both_precisions_and_under_jit(space, dtype):
    ends = np.array([[p.low for p in space.parameters], [p.high for p in space.parameters]], dtype)
    cube = np.array([np.zeros(space.dim), np.ones(space.dim)], dtype)
    for transform in (lambda f: f, jax.jit):
        np.testing.assert_array_equal(transform(space.to_unit)(ends), cube)
        np.testing.assert_array_equal(transform(space.to_physical)(cube), ends)
    assert space.to_unit(ends).dtype == dtype


@settings(deadline=None)
@given(st.tuples(units, units, units), st.sampled_from([0.5, 0.95, 5.0]))
def test_box_coordinates_are_inverted_inside_the_feasible_set(w, damping):
    space = compiled(fosls(damping))
    x = np.asarray(space.from_box(np.array(w)))
    if space.feasible(x):
        np.testing.assert_allclose(space.from_box(space.to_box(x)), x, atol=1e-15)
        if x[0] > 0:
            np.testing.assert_allclose(space.to_box(x), w, rtol=1e-12)


@pytest.mark.parametrize("dtype", [*_deep((np.float32,)), np.float64])
def test_the_whole_box_is_feasible_up_to_its_wall_and_not_beyond(dtype):
    space = fosls()
    w = np.random.default_rng(0).random((2000, 3)).astype(dtype)
    w[:, 0] = 1
    feasible = compiled(space).feasible
    for from_box in (space.from_box, compiled(space).from_box, jax.vmap(space.from_box)):
        assert np.all(feasible(from_box(w)))
    x = np.asarray(space.from_box(w))
    beyond = x * np.array([1 + 1e-4, 1, 1], dtype)
    np.testing.assert_array_equal(feasible(beyond), np.zeros(2000, bool))
    limited = x[:, 0] < 1
    margin = space.passivity_margin(dict(zip(space.names, np.asarray(space.to_physical(x)).T, strict=True)))
    np.testing.assert_allclose(margin[limited], 0.95 * SEARCH_MARGIN, rtol=1e-9 if dtype is np.float64 else 2e-2)


def test_box_coordinates_are_differentiable():
    from_box, w = compiled(fosls()).from_box, np.array([0.5, 0.9, 0.9])
    difference = [np.subtract(from_box(w + h), from_box(w - h)) / 2e-6 for h in 1e-6 * np.eye(3)]
    jacobian = jax.jit(jax.jacobian(fosls().from_box))
    np.testing.assert_allclose(jacobian(w), np.stack(difference, axis=-1), atol=1e-8)
    np.testing.assert_allclose(jacobian(np.array([0.5, 0.0, 0.5])), np.eye(3), atol=1e-12)


def test_a_plain_box_is_its_own_feasible_set():
    x = jnp.array([[0.0, 1.0], [0.5, 1.1]])
    np.testing.assert_array_equal(PLAIN.from_box(x), x)
    np.testing.assert_array_equal(PLAIN.to_box(x), x)
    np.testing.assert_array_equal(PLAIN.feasible(x), [True, False])
    assert PLAIN.derived({"bitrate": 100.0, "height": 144.0}) == {}
    assert PLAIN.passivity_margin({"bitrate": 100.0, "height": 144.0}) is None


def test_stiffness_and_margin_of_a_point():
    point = {"K1": 5.70, "B1": 5.89, "alpha": 0.203}
    assert fosls().passivity_margin(point) == pytest.approx(0.95 - 0.91502, abs=5e-6)
    assert fosls().derived({"K1": 32, "B1": 32, "alpha": 0.01})["K0"] == pytest.approx(-15.696, abs=5e-4)


def minimum_damping(space, x):
    physical = dict(zip(space.names, np.asarray(compiled(space).to_physical(x)).T, strict=True))
    return np.asarray(passivity.minimum_damping(physical["K1"], physical["B1"], physical["alpha"]))


@pytest.mark.parametrize("draw", ["candidates", "latin_hypercube"])
@pytest.mark.parametrize(
    ("damping", "order"), [(0.95, "usual"), *_deep((0.5, "usual"), (0.25, "usual"), (0.95, "other"))]
)
def test_drawn_points_are_feasible_and_repeat(draw, damping, order):
    space, count = fosls(damping, order), 1000 if damping < 0.5 else DRAWN
    x = getattr(space, draw)(count, seed=1)
    assert x.shape == (count, space.dim)
    assert np.all((x >= 0) & (x <= 1))
    assert np.all(minimum_damping(space, x) <= damping * (1 - SEARCH_MARGIN))
    assert np.all(compiled(space).feasible(x))
    np.testing.assert_array_equal(getattr(space, draw)(count, seed=1), x)
    assert not np.array_equal(getattr(space, draw)(count, seed=2), x)
    assert getattr(space, draw)(0, seed=1).shape == (0, space.dim)


@pytest.mark.deep
@pytest.mark.parametrize("delay", [105e-6, 376e-6])
def test_no_point_is_drawn_that_is_not_passive_at_the_delay(delay):
    space = fosls(delay=delay)
    prompt = space.without_delay()
    assert prompt == fosls() and prompt.without_delay() is prompt
    assert 0.1 < space.volume() < fosls().volume() and delay_words(space).startswith(f"{100 * space.volume():.1f} %")
    for x in (space.candidates(4096, 0), space.walls(1024, 0), space.latin_hypercube(64, 0)):
        K1, B1, alpha = np.asarray(compiled(space).to_physical(x)).T
        needed = np.asarray(passivity.minimum_damping(K1, B1, alpha, delay=delay))
        assert np.all(needed <= 0.95 * (1 - SEARCH_MARGIN)) and np.all(compiled(space).feasible(x))
    points = np.asarray(compiled(fosls()).to_physical(fosls().candidates(4096, 0))).T
    passive = np.asarray(passivity.is_passive(*points, 0.95, delay=delay))
    assert 0.6 < passive.mean() < 0.99


@pytest.mark.deep
def test_a_delay_that_leaves_nothing_is_refused_in_one_sentence():
    with pytest.raises(InputError, match=r"at a delay of 0.001 s; check its unit, or lower delay, K_eff"):
        fosls(0.6, delay=1e-3)


@pytest.mark.parametrize("draw", ["candidates", "latin_hypercube"])
@pytest.mark.parametrize(("damping", "order"), [(0.95, "other"), *_deep((0.5, "usual"), (0.95, "usual"))])
def test_drawn_points_fill_the_feasible_set_evenly(draw, damping, order):
    space = fosls(damping, order)
    uniform = qmc.Sobol(space.dim, rng=7).random(2**18)
    accepted = uniform[np.asarray(compiled(space).feasible(uniform))]
    drawn = getattr(space, draw)(DRAWN, seed=3)
    noise = 2e-3 if draw == "candidates" else 2 / np.sqrt(len(drawn))  # four standard errors of a share
    levels = np.linspace(0.02, 0.98, 25)
    for column in range(space.dim):
        shares = np.mean(drawn[:, column, None] <= np.quantile(accepted[:, column], levels), axis=0)
        np.testing.assert_allclose(shares, levels, atol=noise)
    np.testing.assert_allclose(np.corrcoef(drawn.T), np.corrcoef(accepted.T), atol=2 * noise)


def test_a_latin_hypercube_has_one_point_in_each_stratum():
    x = PLAIN.latin_hypercube(50, seed=0)
    np.testing.assert_array_equal(np.sort((50 * x).astype(int), axis=0).T, [range(50)] * 2)
    w = np.asarray(fosls().to_box(fosls().latin_hypercube(50, seed=0)))
    np.testing.assert_array_equal(np.sort((50 * w[:, 0]).astype(int)), range(50))


def test_candidates_have_low_discrepancy():
    counts = np.histogramdd(PLAIN.candidates(1024, seed=0), bins=(32, 32), range=((0, 1), (0, 1)))[0]
    np.testing.assert_array_equal(counts, np.ones((32, 32)))


@pytest.mark.parametrize("space", [PLAIN, fosls(), fosls(0.5), fosls(effective_damping=(10.0, 80.0))])
def test_wall_points_lie_on_every_wall_of_the_feasible_set(space):
    x = space.walls(2000, seed=0)
    assert x.shape == (2000, space.dim) and np.all(compiled(space).feasible(x))
    w = np.asarray(compiled(space).to_box(x))
    at_end = np.minimum(np.abs(w), np.abs(1 - w)) < 1e-9
    assert np.all(at_end.any(axis=1))
    edges = np.mean(at_end.sum(axis=1) > 1)
    if space.mechanics is None or space.mechanics.effective_damping is None:
        made = {2: 2 / 9, 3: 0.3}[space.dim]  # a few of them where nothing is feasible
        assert 0.8 * made < edges < 1.2 * made
    else:
        assert 0.05 < edges < 0.5  # edges whose columns hold nothing feasible drop out
    for column in range(space.dim):
        for end in (0, 1):
            held = np.random.default_rng(column).random((1000, space.dim))
            held[:, column] = end
            # Some walls, as B1 = 0 where damping is asked for, hold nothing feasible.
            feasible = np.mean(compiled(space).feasible(compiled(space).from_box(held))) > 0.1
            assert (np.mean(np.abs(w[:, column] - end) < 1e-9) > 0.02) == feasible
    np.testing.assert_array_equal(space.walls(2000, seed=0), x)


def test_walls_of_one_parameter_are_its_ends():
    assert set(SearchSpace((Parameter("p", 0.0, 1.0),)).walls(8, seed=0).ravel()) == {0.0, 1.0}


@pytest.mark.parametrize("draw", ["candidates", "latin_hypercube"])
def test_a_range_of_effective_damping_is_kept(draw):
    space = fosls(effective_damping=(10.0, 80.0))
    count = DRAWN if draw == "candidates" else 500
    x = getattr(space, draw)(count, seed=0)
    assert len(x) == count and np.all(compiled(space).feasible(x))
    damping = effective_damping(space, x)
    assert np.all((damping >= 10 * (1 - 1e-12)) & (damping <= 80 * (1 + 1e-12)))
    assert np.mean(compiled(space).feasible(fosls().candidates(DRAWN, seed=0))) < 0.9
    with pytest.raises(InputError, match="effective_damping leaves no parameter set"):
        fosls(effective_damping=(1e7, 1e8))


def effective_damping(space, x):
    physical = dict(zip(space.names, np.asarray(compiled(space).to_physical(x)).T, strict=True))
    m = space.mechanics
    return np.asarray(
        viscoelastic.effective_damping(physical["K1"], physical["B1"], physical["alpha"], m.N, m.T, memory=m.memory)
    )


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_box_of_a_damping_range_reaches_its_walls(dtype):
    space = compiled(fosls(effective_damping=(10.0, 80.0)))
    w = np.random.default_rng(0).random((2000, 3)).astype(dtype)
    ends = [np.asarray(space.from_box(np.insert(w[:, 1:], 0, end, axis=1))) for end in (0, 1)]
    width = ends[1] - ends[0]
    some = width[:, 0] > 1e-3
    assert 0.8 < np.mean(some) < 0.95  # the rest of the columns hold no feasible point, and say so
    for end in (0, 1):
        w[:, 0] = end
        x = space.from_box(w)
        np.testing.assert_array_equal(space.feasible(x), width[:, 0] > 0)
        beyond = np.asarray(x).copy()
        beyond[:, 0] += (2 * end - 1) * 1e-3
        assert not np.any(np.asarray(space.feasible(beyond)))
        if dtype is np.float64:
            np.testing.assert_allclose(space.to_box(x)[some], w[some], atol=1e-10)
            damping = effective_damping(fosls(effective_damping=(10.0, 80.0)), x)[some]
            held = np.abs(damping / (10, 80)[end] - 1) < 1e-9
            assert np.mean(held) > 0.1  # the others end at the passive limit, or at the ends of K1


@pytest.mark.parametrize(
    "mechanics",
    [{}, {"effective_damping": (10.0, 80.0)}, {"memory": "full"}, {"memory": "full", "effective_damping": (1e3, 1e5)}],
)
def test_volume_is_the_feasible_share_of_the_box(mechanics):
    space = fosls(**mechanics)
    uniform = qmc.Sobol(3, rng=7).random(2**16)
    assert space.volume() == pytest.approx(np.mean(np.asarray(compiled(space).feasible(uniform))), abs=1.5e-3)
    x = space.candidates(DRAWN, seed=1)
    assert np.all(compiled(space).feasible(x))
    assert float(space.derived({"K1": 5.0, "B1": 5.0, "alpha": 0.2})["K0"]) == pytest.approx(
        0.44 if space.mechanics.memory == "full" else -2.53, abs=0.1
    )


def test_volume_of_the_paper_and_of_a_plain_box():
    assert fosls(0.917 / (1 - SEARCH_MARGIN)).volume() == pytest.approx(0.233, abs=0.002)
    assert PLAIN.volume() == 1


def test_a_damping_range_fills_evenly():
    space = fosls(effective_damping=(10.0, 80.0))
    uniform = qmc.Sobol(3, rng=7).random(2**17)
    accepted, drawn = uniform[np.asarray(compiled(space).feasible(uniform))], space.candidates(DRAWN, seed=3)
    levels = np.linspace(0.02, 0.98, 25)
    for column in range(3):
        shares = np.mean(drawn[:, column, None] <= np.quantile(accepted[:, column], levels), axis=0)
        np.testing.assert_allclose(shares, levels, atol=6e-3)


@pytest.mark.parametrize("method", ["to_unit", "to_physical", "from_box", "to_box", "feasible", "broken"])
@pytest.mark.parametrize("count", [1, 2, 4])
def test_points_of_another_number_of_coordinates_are_refused(method, count):
    """JAX takes the last coordinate again where one is missing, and leaves out what is too many."""
    with pytest.raises(InputError, match="the last axis must have 3 numbers, of K1, B1, alpha"):
        getattr(fosls(), method)(np.full(count, 0.5))
    with pytest.raises(InputError, match="the last axis must have 2 numbers, of bitrate, height"):
        getattr(PLAIN, method)(np.full(3, 0.5))


@pytest.mark.parametrize(
    ("build", "sentence"),
    [
        (lambda: Parameter("p", 2.0, 1.0), "parameters.p.low is 2.0; it must be below high = 1.0"),
        (lambda: Parameter("p", 1.0, 1.0), "it must be below"),
        (lambda: Parameter("p", 0.0, np.inf), "must be finite"),
        (lambda: Parameter("p", -1e308, 1e308), "so that high - low is inf; choose another unit"),
        (lambda: Parameter("p", 1e-300, 1e300, scale="log"), "so that high / low is inf"),
        (lambda: Parameter("p", 0.0, 5e-324), "so that high - low is 5e-324"),
        (lambda: Parameter("p", 0.0, 1.0, scale="log"), "must be above 0"),
        (lambda: Mechanics(K_eff=0.44, damping=0.0), "renderer.damping is 0.0"),
        (lambda: Mechanics(K_eff=-0.1, damping=1.0), "renderer.K_eff is -0.1; it must be 0 or above"),
        (lambda: Mechanics(K_eff=0.44, damping=1.0, N=100), "renderer.N is 100; it must be odd"),
        (lambda: Mechanics(K_eff=0.44, damping=1.0, T=np.nan), "renderer.T is nan"),
        (lambda: Mechanics(K_eff=0.44, damping=1.0, effective_damping=(80.0, 10.0)), "effective_damping is"),
        (lambda: SearchSpace(()), "at least one"),
        (lambda: SearchSpace((K1, K1)), "twice"),
        (lambda: SearchSpace((K1, B1), PAPER), "parameters.alpha is missing"),
        (lambda: SearchSpace((K1, Parameter("B1", 0.0, 32.0), ALPHA), PAPER), "parameters.B1.low is 0.0"),
        (lambda: SearchSpace((K1, B1, Parameter("alpha", 0.01, 1.0)), PAPER), "parameters.alpha.high is 1.0"),
        (lambda: fosls(0.2), "renderer.damping is 0.2 N.s/m, with which no K1 from 1.0 N/mm up is passive"),
    ],
)
def test_a_space_that_cannot_be_is_refused(build, sentence):
    with pytest.raises(InputError, match=sentence):
        build()


def test_the_widest_range_has_finite_points():
    parameter = Parameter("p", 0.5e308, 1.7e308)
    assert parameter.middle == 1.1e308
    assert np.all(np.isfinite(parameter.to_physical(np.linspace(0.0, 1.0, 11))))
