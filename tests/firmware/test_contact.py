"""What the hand must never feel: force in free air, a switch beyond the two sets, motion on a bad encoder."""

import itertools
import subprocess

import numpy as np
import pytest
from helpers_firmware import CAUSES, CORE, STRICT, Device, compiler, parameters

SET = {"K0": -3.18, "K1": 5.58, "B1": 7.88, "alpha": 0.176}
OTHER = {"K0": -2.5, "K1": 4.0, "B1": 6.0, "alpha": 0.2}
SOFT = {"K0": 0.05, "K1": 0.5, "B1": 0.05, "alpha": 0.3}
HARD = {"K0": 1.2, "K1": 0.5, "B1": 1.0, "alpha": 0.3}
STEP = 0.0127
CONTROLLER = 4
FLIP = 1500  # the tick at which a second set is in force


def counts(mm):
    return np.round(np.asarray(mm) / STEP).astype(np.int32)


def alone(model, positions, **config):
    """Forces of one set along the whole motion."""
    device = Device(**config)
    device.go(model)
    return device.run(positions)[0]


def switched(old, new, positions, **config):
    """Forces where `new` follows `old` at the tick FLIP."""
    device = Device(**config)
    device.go(old)
    first, _ = device.run(positions[: FLIP - 300])
    staged = device.stage(new, 2)
    warming, _ = device.run(positions[FLIP - 300 : FLIP])
    assert device.confirm("COMMIT", staged)[0] == "ACK"
    rest, _ = device.run(positions[FLIP:])
    return np.concatenate([first, warming, rest])


def test_a_switch_begins_at_the_force_that_was_given_not_at_the_model_s():
    """Set A is limited to 1 N and its model would give far more; set B is soft."""
    positions = counts(np.r_[np.linspace(0, 4, 400), np.full(2500, 4.0)])
    limited = SET | {"force_limit": 1.0}
    forces = switched(limited, SOFT, positions)
    assert forces[FLIP - 1] == 1.0 and alone(SET, positions)[FLIP] > 1.5
    assert 0.1 < alone(SOFT, positions)[-1] < 1.0
    assert np.max(forces[FLIP:]) <= 1.0


@pytest.mark.parametrize("slew", [50.0, 2000.0])
@pytest.mark.parametrize("stroke", ["sine", "lets go", "comes back", "half way out"])
def test_a_switch_stays_between_the_two_forces(slew, stroke):
    """Or rises there as fast as the slew limit allows. The forces of each set alone differ a little from those in a
    session, in which the new set's history begins at an equilibrium."""
    t = np.arange(3500) / 1000
    since = np.maximum(t - FLIP / 1000, 0)
    moved = {
        "sine": np.sin(9 * t),
        "lets go": -20 * since,
        "comes back": 3 * np.sin(12 * since),
        "half way out": -np.minimum(150 * since, 2.0),
    }
    positions = counts(np.minimum(3 + moved[stroke], 20 * t))
    sets = (SET, OTHER, SOFT, HARD)
    each = [alone(model, positions, slew=1e5) for model in sets]
    for (old, a), (new, b) in itertools.permutations(zip(sets, each, strict=True), 2):
        forces = switched(old, new, positions, slew=slew)
        low, high, before, after = (
            np.minimum(a, b)[FLIP:],
            np.maximum(a, b)[FLIP:],
            forces[FLIP - 1 : -1],
            forces[FLIP:],
        )
        slack = 0.03 * np.max(high)
        assert np.all(after <= high + slack)
        assert np.all(after >= np.minimum(low - slack, before + slew / 1000 - 1e-5))
        assert not np.any(forces[positions <= 0])


def test_a_switch_to_a_set_of_a_small_limit_is_a_switch_and_no_slew():
    positions = counts(np.r_[np.linspace(0, 4, 400), np.full(2500, 4.0)])
    device = Device(slew=100.0)
    device.go(SET)
    device.run(positions[:800])
    staged = device.stage(SOFT | {"force_limit": 0.2}, 2)
    device.run(positions[800 : 800 + device.status()["ticks_until_ready"]])
    before = device.status()
    device.confirm("COMMIT", staged)
    forces, _ = device.run(positions[-400:])
    assert np.all(np.diff(np.r_[before["force_N"], forces]) <= 0) and forces[-1] == np.float32(0.2)
    assert before["force_N"] > 1.5 and device.status()["slewed"] == before["slewed"]


def test_leaving_just_after_a_commit_is_no_force_in_free_air():
    positions = counts(np.r_[np.linspace(0, 4, 400), np.full(600, 4.0)])
    device = Device(slew=100.0)
    device.go(SET)
    device.run(positions)
    staged = device.stage(SOFT, 2)
    device.run(np.full(device.status()["ticks_until_ready"], positions[-1]))
    assert device.confirm("COMMIT", staged)[0] == "ACK"
    away = counts(np.r_[np.linspace(4, -1, 12), np.full(200, -1.0)])
    forces, _ = device.run(away)
    assert not np.any(forces[away <= 0])


def test_the_slew_limit_holds_no_force_up_in_free_air():
    device = Device(slew=500.0)
    device.go(HARD)
    positions = counts(np.r_[np.linspace(0, 6, 300), np.full(100, 6.0), 6 - 0.89 * np.arange(1, 20)])
    forces, _ = device.run(positions)
    assert forces[399] > 4 and not np.any(forces[positions <= 0])
    again, _ = device.run(counts(np.linspace(0, 1, 50)))
    assert np.all(np.diff(np.r_[0, again]) <= 0.5 + 1e-6)


@pytest.mark.parametrize("leave", [True, False])
def test_the_passivity_controller_acts_in_contact_and_adds_no_more_than_the_device_s_damping(leave):
    """A motion that takes energy out of the slewed rendering: deep and slow in, fast out and in again."""
    device = Device(capabilities=3 | CONTROLLER, slew=200.0)
    device.go(HARD)
    bottom = -0.5 if leave else 0.3
    stroke = np.r_[np.linspace(0, 5, 60), np.full(400, 5.0), np.linspace(5, bottom, 40), bottom, bottom + STEP, bottom]
    positions = counts(np.r_[np.tile(stroke, 3), np.full(50, -0.5), -0.5 + STEP * (np.arange(60) % 2)])
    with_it, flags = device.run(positions)
    assert np.any(flags & 16) and not np.any(flags[positions <= 0] & 16)
    assert not np.any(with_it[positions <= 0])
    model = alone(HARD, positions, slew=1e5)
    velocity = np.maximum(np.diff(np.r_[0, positions]), 0) * STEP  # mm per tick: m/s
    assert np.all(with_it <= model + 0.95 * velocity + 1e-4)


def test_the_passivity_controller_adds_as_much_as_the_device_s_damping():
    """Where the hand moves in and is owed more than that: with a lower bound, energy would be left to be taken back."""
    device = Device(capabilities=3 | CONTROLLER)
    device.go({"K0": 1.8, "K1": 0.5, "B1": 0.001, "alpha": 0.2})
    positions = np.r_[np.linspace(1, 100, 30), 200 - 100 * np.cos(2 * np.pi * 20 * np.arange(1000) / 1000)].round()
    with_it, flags = device.run(positions)
    velocity = np.diff(np.r_[0, positions]) * STEP
    extra = with_it - np.float32(1.8) * positions * STEP
    owed = (flags & 16 > 0) & (velocity > 0.03)
    assert np.max(extra[owed] / velocity[owed]) > 0.9


def test_what_is_left_of_a_difference_ends_with_the_contact():
    device = Device(slew=50.0)
    device.go(SET, 1)
    device.run(counts(np.r_[np.linspace(0, 4, 200), np.full(50, 4.0)]))
    staged = device.stage(SET | {"K0": -2.5, "K1": 4.0, "B1": 6.0}, 2)
    device.run(np.full(400, 315))
    device.confirm("COMMIT", staged)
    device.run([315] * 3)
    assert device.offset != 0
    device.run(np.arange(315, -60, -60))
    assert device.offset == 0
    assert device.ask("SET_PARAMS", parameters(SET, 3))[0] == "ACK"  # no longer BUSY


def test_a_second_change_of_the_set_goes_on_from_the_first_one_s_limit():
    """Of either bank: the force before the change is within its own set's limit."""
    device = Device(slew=4e4)
    device.go(SET | {"force_limit": 1.0}, 1)
    device.run(counts(np.r_[np.linspace(0, 4, 200), np.full(50, 4.0)]))
    for set_id, limit in ((2, 1.5), (3, 30.0)):
        staged = device.stage(SET | {"B1": 7.0 + set_id, "force_limit": limit}, set_id)
        device.run(np.full(400, 315))
        assert device.confirm("COMMIT", staged)[0] == "ACK"
        before = 1.0 if set_id == 2 else 1.5
        assert device.tick(315) == pytest.approx(before, abs=1e-5)
        device.run(np.full(100, 315))


@pytest.mark.parametrize(("period", "good"), [(3, 1), (2, 1), (3, 2)], ids=["2 of 3 bad", "1 of 2 bad", "1 of 3 bad"])
def test_an_encoder_that_fails_again_and_again_holds(period, good):
    device = Device()
    device.go(SET)
    device.run(counts(np.linspace(0, 2, 100)))
    for tick in range(100):
        device.beat()
        device.tick(157, valid=tick % period < good)
    status = device.status()
    assert (device.state, CAUSES[status["hold_reason"]]) == ("HOLD", "INPUT")


def test_a_lost_sample_now_and_then_is_bridged():
    device = Device()
    device.go(SET)
    for tick in range(20_000):
        device.tick(100, valid=tick % 12 > 0)
        if tick % 50 == 0:
            device.beat()
    assert device.state == "RUNNING"


def test_after_estop_the_force_is_zero_before_anything_else():
    device = Device()
    staged = device.go(SET)
    device.run(counts(np.r_[np.linspace(0, 3, 100), np.full(50, 3.0)]))
    device.beat()
    device.must("ESTOP")
    kind, message = device.ask("CLEAR", boot_id=7)
    assert (kind, message["reason"], message["ticks"]) == ("NACK", "BUSY", 1)
    assert device.confirm("START", staged)[1]["reason"] == "STATE"
    assert device.tick(236) == 0
    device.must("CLEAR", boot_id=7)
    device.beat()
    assert device.confirm("START", staged)[1]["reason"] == "IN_CONTACT"
    device.run(np.linspace(236, 0, 20))
    assert device.confirm("START", staged)[0] == "ACK"
    assert device.tick(0) == 0


def test_no_start_on_an_encoder_that_gives_no_number():
    device = Device()
    staged = device.stage(SET)
    device.confirm("COMMIT", staged)
    for ticks in (1, 1, 1, 5):
        for _ in range(ticks):
            device.tick(0, valid=False)
        device.beat()
        assert device.confirm("START", staged)[1]["reason"] == "NO_INPUT"
    device.tick(0)
    assert device.confirm("START", staged)[0] == "ACK"


def test_a_refused_config_gives_no_force_and_no_answer():
    device = Device(hello=False, watchdog_ticks=0)
    assert device.error != 0
    device.feed(b"\0\0\0")
    assert device.drain() == b""
    assert [device.tick(500) for _ in range(5)] == [0.0] * 5


@pytest.mark.parametrize(
    "changed",
    [
        {"tick_rate_Hz": 100, "watchdog_ticks": 60000},
        {"watchdog_ticks": 1001},
        {"hold_ticks": 101},
        {"tick_rate_Hz": 100, "hold_ticks": 20},
    ],
)
def test_no_silence_of_more_than_a_second_and_no_ramp_of_more_than_a_tenth(changed):
    assert Device(hello=False, **changed).error == 1


def test_a_port_of_other_maxima_does_not_link_and_fast_math_does_not_compile(tmp_path):
    (tmp_path / "port.c").write_text(
        '#include "hb_device.h"\nint main(void)\n{\n    static struct hb_device device;\n'
        "    static const struct hb_config config = {.tick_rate_Hz = 1000U};\n"
        "    return (int)hb_init(&device, &config, 1U);\n}\n"
    )

    def made(*options, objects=()):
        command = [compiler(), *STRICT, f"-I{CORE}", *options, *map(str, objects)]
        return subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)

    sources = sorted(CORE.glob("*.c"))
    assert made("-c", objects=sources).returncode == 0
    core = sorted(tmp_path.glob("*.o"))
    assert made("port.c", "-o", "port", objects=core).returncode == 0
    other = made("-DHB_MAX_TAPS=101U", "port.c", "-o", "port", objects=core)
    assert other.returncode != 0 and "hb_init_101U" in other.stderr
    assert "fast-math" in made("-ffast-math", "-c", "port.c", "-o", "fast.o").stderr
    (tmp_path / "careless.c").write_text((tmp_path / "port.c").read_text().replace("return (int)hb", "hb"))
    assert "unused" in made("-c", "careless.c", "-o", "careless.o").stderr
