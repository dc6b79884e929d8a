"""The oracles against each other, so that a mistake in one of them is not taken for a mistake of hilbo."""

import importlib.util
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from datasets import SMALL, hostile_cases, repeated, repeated_19
from mpmath import mp
from reference_laplace import bcm_mp, mpmath_laplace, numpy_laplace, numpy_ordinal_terms, ordinal_log_prob_mp
from scipy.special import ndtr

QUANTITIES = ("mode", "mean", "variance", "log_evidence")


def _load_benchmark_reference():
    path = Path(__file__).parents[2] / "benchmarks" / "reference_numpy.py"
    spec = importlib.util.spec_from_file_location("reference_numpy", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


textbook = _load_benchmark_reference()


def _error(value, exact) -> float:
    """Largest |value - exact| / max(1, |exact|), the difference taken before rounding the exact value."""
    value, exact = np.atleast_1d(np.asarray(value, object)), np.atleast_1d(np.asarray(exact, object))
    return max((float(abs(v - e) / max(1, abs(e))) for v, e in zip(value, exact, strict=True)), default=0.0)


def _hyper(dataset, log_theta: float = 0.0, log_noise: float = 0.0):
    """The data set's hyperparameters for the textbook form, moved by so much on the log scale."""
    theta, noise = dataset.theta * np.exp(log_theta), dataset.noise * np.exp(log_noise)
    return textbook.Hyper(theta, dataset.variance, dataset.thresholds, noise)


SCALAR_THETA = [make for make in SMALL if np.ndim(make().theta) == 0]


@pytest.mark.parametrize(
    "make", [pytest.param(make, marks=[pytest.mark.deep] * (make not in (repeated, repeated_19))) for make in SMALL]
)
def test_numpy_agrees_with_50_digits(make):
    dataset = make()
    computed, exact = numpy_laplace(*dataset.problem()), mpmath_laplace(*dataset.problem())
    assert exact["residual"] * dataset.noise < 1e-50
    assert computed["residual"] < 1e-12
    for quantity in QUANTITIES:
        assert _error(computed[quantity], exact[quantity]) < 1e-10, quantity


def test_hostile_cases_agree_as_far_as_float64_reaches():
    cases = [case for case in hostile_cases() if len(case.q) in (1, 25)][::25]
    for case in cases:
        computed, exact = numpy_laplace(*case.problem()), mpmath_laplace(*case.problem(), digits=30)
        worst = max(_error(computed[quantity], exact[quantity]) for quantity in QUANTITIES)
        assert worst < max(1e-10, 1e2 * computed["rounding"]), case.name


def test_the_mode_solves_the_50_digit_equations_in_another_form():
    """f = K grad log p(f), the gradient by numerical differentiation of log p at 40 digits."""
    dataset = repeated()
    exact = mpmath_laplace(*dataset.problem())
    edges = [-mp.inf, *map(mp.mpf, dataset.thresholds), mp.inf]
    with mp.workdps(40):

        def log_p(f, k):
            return mp.log(mp.ncdf((edges[k + 1] - f) / dataset.noise) - mp.ncdf((edges[k] - f) / dataset.noise))

        gradient = [mp.diff(lambda f, k=k: log_p(f, int(k)), f) for f, k in zip(exact["mode"], dataset.q, strict=True)]
        points = [[mp.mpf(v) for v in row] for row in dataset.x]
        for p, f in zip(points, exact["mode"], strict=True):
            k = [mp.exp(-30 * mp.fsum((s - r) ** 2 for s, r in zip(p, z, strict=True))) for z in points]
            assert abs(mp.fdot(k, gradient) - f) < 1e-30


def test_no_data_gives_the_prior():
    case = next(hostile_cases())
    for solve in (numpy_laplace, mpmath_laplace):
        prior = solve(*case.problem())
        assert prior["log_evidence"] == 0
        assert _error(prior["mean"], np.zeros(4)) == 0
        assert _error(prior["variance"], np.full(4, case.variance)) == 0


def test_one_answer_evidence_is_near_the_exact_probability():
    """At n = 1 the evidence is Phi(t'/s) - Phi(t/s), s^2 = variance + noise^2; Laplace is close at large noise."""
    case = next(c for c in hostile_cases() if c.noise == 10 and c.variance == 1 and len(c.q) == 1)
    edges = np.array([-np.inf, -0.5, 0.5, np.inf])[[case.q[0], case.q[0] + 1]]
    exact = np.log(np.diff(ndtr(edges / np.hypot(1.0, case.noise))))[0]
    assert numpy_laplace(*case.problem())["log_evidence"] == pytest.approx(exact, abs=1e-4)


def test_hostile_grid_is_complete_finite_and_repeatable():
    cases = list(hostile_cases())
    assert len(cases) == len({case.name for case in cases}) == 540
    assert {len(case.q) for case in cases} == {0, 1, 25, 200}
    for first, second in zip(cases[:20], islice(hostile_cases(), 20), strict=True):
        np.testing.assert_array_equal(first.x, second.x)
        np.testing.assert_array_equal(first.q, second.q)
    for case in cases[::9]:
        computed = numpy_laplace(*case.problem())
        assert all(np.all(np.isfinite(computed[quantity])) for quantity in QUANTITIES), case.name


def test_repeats_conflict_and_are_exact():
    for dataset, counts in ((repeated(), [8, 5, 2]), (repeated_19(), [19, 5, 1])):
        _, stimulus, times = np.unique(dataset.x, axis=0, return_inverse=True, return_counts=True)
        assert sorted(times, reverse=True) == counts
        assert len(set(dataset.q[stimulus == np.argmax(times)])) == 3


@pytest.mark.parametrize("width", [1e-3, 0.1, 1.0, 30.0, 1e3, np.inf])
def test_numpy_log_prob_against_mpmath(width):
    """Within 12 noise units, where float64 differences suffice; a narrow category costs its width in digits."""
    noise, lower = 0.5, -0.5
    f = noise * np.linspace(-12, 12, 25) + 0.01
    thresholds = (lower,) if np.isinf(width) else (lower, lower + width * noise)
    log_p, gradient, curvature = numpy_ordinal_terms(f, np.ones(25, int), thresholds, noise)
    upper = [*thresholds, np.inf][1]
    exact = np.array([ordinal_log_prob_mp(v, lower, upper, noise) for v in f], dtype=object)
    slack = max(1.0, 1 / width)
    assert _error(log_p, exact[:, 0]) < 1e-13 * slack
    # r = phi / p is 1 / width, and so is what cancels in the gradient, its square in the curvature
    assert np.max(np.abs((gradient - exact[:, 1]).astype(float))) < 1e-12 * slack**2 / noise
    assert np.max(np.abs((curvature - exact[:, 2]).astype(float))) < 1e-11 * slack**3 / noise**2


@pytest.mark.parametrize("units", [0.0, 30.0, *(pytest.param(u, marks=pytest.mark.deep) for u in (1.0, 1000.0))])
@pytest.mark.parametrize("width", [1e-3, 1e3, pytest.param(1.0, marks=pytest.mark.deep)])
def test_mpmath_log_prob_against_a_200_digit_quotient(units, width):
    """Plain Phi(u) - Phi(l) and numerical derivatives, with so many digits that nothing can cancel."""
    noise, lower = 0.1, 0.3
    upper = lower + width * noise
    f = lower - units * noise  # the doubles as they are: mpf is exact on them
    values = ordinal_log_prob_mp(f, lower, upper, noise)
    with mp.workdps(200 if units < 100 else 1500):
        c = mp.mpf(noise)

        def log_p(s):
            below, above = (mp.erfc((mp.mpf(t) - s) / c / mp.sqrt(2)) for t in (upper, lower))
            return mp.log((above - below) / 2)

        exact = log_p(mp.mpf(f)), mp.diff(log_p, mp.mpf(f)), -mp.diff(log_p, mp.mpf(f), 2)
        for value, other in zip(values, exact, strict=True):
            assert abs(value - other) < mp.mpf(10) ** -45 * abs(other)


@pytest.mark.parametrize("make", SCALAR_THETA)
def test_textbook_fit_and_prediction(make):
    dataset = make()
    posterior = textbook.fit(dataset.x, dataset.q, _hyper(dataset))
    mean, sd = textbook.predict(posterior, dataset.x_new)
    exact = numpy_laplace(*dataset.problem())
    assert _error(mean, exact["mean"]) < 1e-10
    assert _error(sd**2, exact["variance"]) < 1e-10
    assert _error(posterior.log_evidence, exact["log_evidence"]) < 1e-10


@pytest.mark.parametrize("make", SCALAR_THETA)
def test_textbook_evidence_gradient_against_finite_differences(make):
    """Central differences of the other reference's evidence, extrapolated once (step h and h/2)."""
    dataset = make()
    value, gradient = textbook.evidence_and_gradient(dataset.x, dataset.q, _hyper(dataset))

    def evidence(step):
        h = _hyper(dataset, *step)
        problem = (dataset.x, dataset.q, h.theta, h.variance, h.thresholds, h.noise, dataset.x_new)
        return numpy_laplace(*problem)["log_evidence"]

    def slope(axis, h):
        return (evidence(h * axis) - evidence(-h * axis)) / (2 * h)

    assert value == pytest.approx(evidence(np.zeros(2)), abs=1e-10)
    for axis, component in zip(np.eye(2), gradient, strict=True):
        difference = (4 * slope(axis, 1e-3) - slope(axis, 2e-3)) / 3
        assert component == pytest.approx(difference, rel=1e-8, abs=1e-9)


def test_textbook_session_study_and_hyperparameters():
    rng = np.random.default_rng(7)
    candidates, peak = rng.random((500, 3)), np.array([0.4, 0.6, 0.3])

    def answer(point, trial):
        return int(np.searchsorted([-0.5, 0.5], 1.5 - 8 * np.sum((point - peak) ** 2)))

    people = [textbook.session_25(rng.random((5, 3)), candidates, answer) for _ in range(3)]
    assert all(x.shape == (25, 3) and set(q) <= {0, 1, 2} for x, q in people)
    mean, variance = textbook.study_24x25_bcm(people, candidates)
    each = [numpy_laplace(x, q, 30.0, 1.0, (-0.5, 0.5), 0.5, candidates[:5]) for x, q in people]
    exact = bcm_mp([e["mean"] for e in each], [e["variance"] for e in each], 1.0)
    assert max(_error(mean[:5], exact[0]), _error(variance[:5], exact[1])) < 1e-9

    best, evidence = textbook.optimise_hyperparameters(*people[0], np.array([[30.0, 0.5], [5.0, 1.0]]))
    value, gradient = textbook.evidence_and_gradient(*people[0], best)
    inside = np.array([0.1 < best.theta < 1e3, 0.0501 < best.noise < 10])
    assert evidence == pytest.approx(value, abs=1e-12)
    assert np.max(np.abs(gradient[inside]), initial=0.0) < 1e-3


def test_bcm_of_one_person_is_that_person_and_the_prior_adds_nothing():
    mean, variance = bcm_mp([[0.3, -0.2]], [[0.5, 0.7]], 1.0)
    assert max(_error(mean, [0.3, -0.2]), _error(variance, [0.5, 0.7])) < 1e-16
    mean, variance = bcm_mp([[0.3], [0.0], [0.0]], [[1.2], [2.0], [2.0]], [2.0])
    assert max(_error(mean, [0.3]), _error(variance, [1.2])) < 1e-16


def test_bcm_keeps_the_digits_of_many_weak_experts():
    """1e4 equal experts who each take 2^-40 of the prior variance: added precision n (1/v - 1) in closed form."""
    n, v = 10_000, 1.0 - 2.0**-40
    mean, variance = bcm_mp(np.full((n, 1), 0.25), np.full((n, 1), v), 1.0)
    with mp.workdps(50):
        precision = 1 + n * (1 / mp.mpf(v) - 1)
        assert abs(variance[0] * precision - 1) < mp.mpf(10) ** -45
        assert abs(mean[0] - n / mp.mpf(v) * mp.mpf(0.25) / precision) < mp.mpf(10) ** -40
