"""The bridge against the firmware's own core, as a process of this computer. Only device ticks are asserted."""

import contextlib
import random

import numpy as np
import pytest
from material import FOAM, force, position
from simulated import ENVIRONMENT, FaultyPort, needs_device, own_cache  # noqa: F401

from hilbo.device import messages
from hilbo.device.link import Link
from hilbo.device.local.simulator import Simulator
from hilbo.device.reasons import NackReason, SampleFlag
from hilbo.device.telemetry import Samples
from hilbo.errors import InputError
from hilbo.hardware_bridge import DeviceError, RefusalError, Renderer, State
from hilbo.identification.material_tables import read_material
from hilbo.identification.motor import device_tests
from hilbo.identification.motor.pressing import pressed
from hilbo.identification.sampled import Sampled
from hilbo.viscoelastic import FOSLS

pytestmark = needs_device

A = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}
S = {"K0": -2.89, "K1": 5.70, "B1": 5.89, "alpha": 0.203}
FULL = {"K0": 0.4, "K1": 1.2, "B1": 3.0, "alpha": 0.35, "memory": "full"}
FAST = {"rate": "lockstep"}


def quiet(_words):
    """Says nothing."""


@pytest.fixture
def device():
    """A device whose time passes as fast as it can, pressed by a finger."""
    with Renderer.open("sim", options=FAST | {"finger": "sine"}) as renderer:
        yield renderer


@pytest.mark.parametrize("wanted", [A, S, FULL])
def test_the_device_renders_what_viscoelastic_says(wanted):
    with Renderer.open("sim", options=FAST | {"finger": "none"}) as device:
        confirmed = device.send(**wanted)
        device.start()
        device.simulator.tell("finger sine")
        seen = device.samples(3.0)
    assert np.all(np.diff(seen.tick) == 1)
    numbers = {name: float(np.float32(value)) for name, value in wanted.items() if name != "memory"}
    model = FOSLS(**numbers, memory=wanted.get("memory", "short"))
    force = np.asarray(model.simulate(np.maximum(seen.position_mm, 0), unilateral=True))
    running = (seen.flags & SampleFlag.RUNNING) != 0
    running[: np.argmax(running) + 100] = False  # force begins at 0, under the slew limit
    assert running.sum() > 2000 and force[running].max() > 1
    # Of the largest force; the sum of exponentials keeps rounding.
    bound = 2e-4 if confirmed.memory == "short" else 2e-3
    np.testing.assert_allclose(seen.force_N[running], force[running], rtol=0, atol=bound * force.max())


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        ({"K1": 30.0}, NackReason.NOT_PASSIVE),
        ({"N": 100}, NackReason.EVEN_TAPS),
        ({"N": 257}, NackReason.MEMORY_LENGTH),
        ({"K0": -100.0}, NackReason.K0_RANGE),
        ({"K1": 65.0}, NackReason.K1_RANGE),
        ({"B1": 0.0}, NackReason.B1_RANGE),
        ({"alpha": 0.999}, NackReason.ALPHA_RANGE),
        ({"force_limit": 25.0}, NackReason.FORCE_LIMIT),
        ({"K0": -4.5}, NackReason.STATIC_STIFFNESS),
    ],
)
def test_what_the_device_refuses_leaves_it_as_it_was(device, wrong, reason):
    before = device.send(**A)
    device.start()
    with pytest.raises(RefusalError) as error:
        device.send(**(A | wrong))
    assert error.value.nack.reason == reason
    assert str(error.value).endswith(".")
    assert (device.in_force(), device.state()) == (before, State.RUNNING)


def test_sets_are_changed_while_somebody_presses(device):
    device.send(**A)
    device.start()
    device.samples(0.5)
    slew = device.device.slew_limit_N_per_s * device.tick_s
    for wanted in (S, FULL, A):
        confirmed = device.send(**wanted)
        assert np.float32(wanted["K1"]) == confirmed.K1
        seen = device.samples(0.5)
        assert np.abs(np.diff(seen.force_N)).max() <= 3 * slew
    assert device.status().holds == 0


def test_silence_of_the_host_is_hold(device):
    device.send(**A)
    device.start()
    device.samples(0.5)
    with device.link.silence():
        device_tests.wait_until(device, lambda: device.state() == State.HOLD, "let go")
    with pytest.raises(DeviceError, match="START is refused while the device is HOLD"):
        device.start()
    device_tests.wait_until(device, lambda: device.status().force_N == 0, "rested")
    device.clear()
    device.simulator.tell("finger ramp")
    device_tests.wait_until(device, lambda: not device.status().contact, "been let go")
    device.start()
    assert device.state() == State.RUNNING
    assert any("HOLD, no fresh heartbeat" in words for words in device.events())


def test_a_simulated_device_that_has_ended_answers_nothing():
    device = Renderer.open("sim", options=FAST)
    device.simulator._process.kill()
    for _ in range(2):  # before and after the system has closed the pipe
        with pytest.raises(DeviceError, match="has ended; open a new one"):
            device.simulator.tell("finger hold")
    with contextlib.suppress(DeviceError):
        device.close()


def test_self_test_of_a_good_device():
    with Renderer.open("sim", options=FAST | {"finger": "none"}) as device:
        result = device_tests.selftest(device, quiet, 100)
    assert (result.asked, result.echoes) == (100, 100)
    assert 0 < result.watchdog_ticks <= result.watchdog_limit == 250
    assert result.force_after_N == 0


def test_a_drive_that_is_out_of_range_is_refused():
    with Renderer.open("sim", options=FAST | {"finger": "none"}) as device:
        with pytest.raises(RefusalError, match="DRIVE asks for 30, beyond the device's limit of 20"):
            device.drive("position", "hold", 30, duration=1)
        with pytest.raises(RefusalError, match="DRIVE asks for 200000, beyond the device's limit of 120000"):
            device.drive("force", "hold", 1, duration=200)
        seen = device_tests.drive(device, "position", "hold", 3.0, duration=1.0)
        assert abs(seen.position_mm[-1] - 3) < 0.1


def test_a_drive_that_ends_early_is_not_used():
    with Renderer.open("sim", options=FAST | {"finger": "none"}) as device:
        samples = device.samples

        def stopped(seconds):
            telemetry = samples(min(seconds, 0.3))
            if seconds > 1:
                device.estop()
            return telemetry

        device.samples = stopped
        with pytest.raises(DeviceError, match="ended its drive early, now ESTOP"):
            device_tests.drive(device, "position", "hold", 3.0, duration=120.0)


STEPS = [messages.SetParams, messages.Commit, messages.GetSet, messages.Start]


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.__name__)
def test_a_restart_at_any_step_never_renders_what_nobody_confirmed(step):
    with Renderer.open("sim", options=FAST | {"finger": "hold"}) as device:
        ask, restarts = device.link.request, iter([step])

        def request(message):
            if isinstance(message, step) and next(restarts, None):
                device.simulator.tell("restart")
            return ask(message)

        device.link.request = request
        with pytest.raises(DeviceError, match="the device has restarted"):
            _send_and_start(device)
        status = ask(messages.GetStatus())
        assert (status.state, status.active_id) == (State.STOPPED, 0)
        assert device.reconnect() is False
        assert device.in_force() is None and device.state() == State.STOPPED
        _send_and_start(device)
        assert device.state() == State.RUNNING


def _send_and_start(device):
    device.send(**A)
    device.start()


@pytest.mark.parametrize("rate", [1e-4, 1e-3])
def test_a_bad_line_costs_tries_and_never_a_wrong_set(rate):
    simulator = Simulator(finger="sine", rate="lockstep")
    ports = []

    def connect():
        ports.append(FaultyPort(simulator.port, rate, len(ports)))
        return Link(ports[-1], patience=0.08, tries=200, ticks=simulator.ticks)

    device = Renderer(connect, simulator=simulator)
    rng = random.Random(0)
    for n in range(20):
        wanted = {"K0": 0.3, "K1": rng.uniform(0.1, 1), "B1": rng.uniform(0.1, 1), "alpha": rng.uniform(0.1, 0.9)}
        confirmed = device.send(**wanted)
        assert (confirmed.K1, confirmed.alpha) == tuple(np.float32([wanted["K1"], wanted["alpha"]]))
        assert device.echo(bytes([n]) * 30) == bytes([n]) * 30
    device.start()
    assert device.in_force() == confirmed
    assert ports[0].faults > 0
    counted = device.link.dropped + device.status().frames_dropped
    assert counted > 0 or rate < 1e-3  # one of a few faults may be bytes that came twice, of which nothing is dropped
    device.close()


def test_a_port_that_is_used_is_busy_and_one_that_vanishes_is_gone():
    device = Renderer.open("sim", patience=30)
    with pytest.raises(InputError, match="another program uses this port"):
        Renderer.open(device.simulator.port)
    device.simulator._process.kill()
    with pytest.raises(DeviceError, match="the line to the device is gone"):
        device.samples(10.0)
    with pytest.raises(DeviceError, match="The simulated device has ended"):
        device.reconnect()
    with pytest.raises(DeviceError, match="ended; open a new one"):
        device.simulator.tell("restart")
    device.link.close()
    device.simulator.close()


def test_a_real_port_has_no_options():
    with pytest.raises(InputError, match="options are for the simulated device"):
        Renderer.open("/dev/null", options={"finger": "sine"})
    with pytest.raises(InputError, match="--finger thumb makes no sense"):
        Renderer.open("sim", options={"finger": "thumb"})


def test_measure_damping_finds_the_simulators_own():
    options = {"finger": "none", "damping": 1.3, "coulomb": 0.05, "seed": 3}
    with Renderer.open("sim", options=FAST | options) as device:
        estimates = device_tests.measure_damping(device, quiet)
    for estimate, truth in ((estimates.damping, 1.3), (estimates.coulomb, 0.05), (estimates.constant, 0.0)):
        assert estimate.lower <= truth <= estimate.upper
    assert estimates.mass.value == pytest.approx(0.3, rel=0.02)
    assert estimates.damping.upper - estimates.damping.lower < 0.02


def test_measure_damping_needs_a_free_device():
    with (
        Renderer.open("sim", options=FAST | {"material": (*FOAM, 101)}) as device,
        pytest.raises(DeviceError, match="Something touches the handle"),
    ):
        device_tests.measure_damping(device, quiet)


def characterised(tmp_path, **numbers):
    options = {"material": (*FOAM, 101), "noise": 0.02, "seed": 1}
    with Renderer.open("sim", options=FAST | options) as device:
        table = device_tests.characterise(device, quiet, **numbers)
    table.to_csv(tmp_path / "tests.csv", index=False)
    return read_material(tmp_path / "tests.csv")


def test_characterise_makes_the_table_that_identify_reads(tmp_path):
    material = characterised(tmp_path, repeats=3, hold=0.5, rest=0.5)
    assert [(test.kind, test.repeats) for test in material.tests] == [("relaxation", 3), ("creep", 3)]
    assert material.notes == ()
    for test, answer in zip(material.tests, (force, position), strict=True):
        # Rows off the material are left out: there the input is 0.
        grid = np.arange(round(test.time[-1] * 1000) + 1) / 1000
        for put, out in zip(test.input, test.output, strict=True):
            expected = answer(FOAM, np.interp(grid, test.time, put))
            at = np.round(test.time * 1000).astype(int)
            assert np.std(out - expected[at]) < 0.01 * np.ptp(out)


def test_repeats_that_were_whole_stay_when_a_later_one_fails(monkeypatch):
    real, count = device_tests.drive, iter(range(1, 99))

    def failing(device, *way, **times):
        if next(count) > 10:  # within the third repeat, of four drives each
            raise DeviceError("The device has ended its drive early.")
        return real(device, *way, **times)

    monkeypatch.setattr(device_tests, "drive", failing)
    options = {"material": (*FOAM, 101), "noise": 0.02, "seed": 1}
    with (
        Renderer.open("sim", options=FAST | options) as device,
        pytest.raises(device_tests.CutShortError, match="ended its drive early") as cut,
    ):
        device_tests.characterise(device, quiet, repeats=4, hold=0.2, rest=0.1)
    assert cut.value.repeats == 2 and set(cut.value.table["repeat"]) == {1, 2}


def test_a_material_that_is_not_there_is_said():
    still = Samples(*(np.zeros(100) for _ in Samples._fields))
    with pytest.raises(DeviceError, match="The relaxation test has met nothing at position 0"):
        pressed(still, "relaxation", True, 0.0)
    with Renderer.open("sim", options=FAST) as device, pytest.raises(InputError, match="must be above 0"):
        device_tests.characterise(device, quiet, repeats=0)


@pytest.mark.deep
@pytest.mark.parametrize("lag", [0.0, "fit"])
def test_characterise_and_identify_return_the_simulators_own_parameters(tmp_path, lag):
    """Also where lag and filter are sought, as by default: a shift of rounded positions would lower the residuals, and
    a filter would describe a recovery without contact."""
    from hilbo.identification.characterise import characterise

    material = characterised(tmp_path)
    result = characterise(material.tests, Sampled(101, lag=lag), 0, (), quiet, find_filter=lag == "fit")
    (warning,) = result.warnings
    assert "corner" not in result.estimates and warning.startswith("The handle left the material at 3.03")
    for name, truth in zip(("K0", "K1", "B1", "alpha"), FOAM, strict=True):
        estimate = result.estimates[name]
        assert estimate.lower <= truth <= estimate.upper, (name, truth, estimate)
