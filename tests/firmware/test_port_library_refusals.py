"""What the renderer library refuses, in sentences; K0 of a stiffness; and its header in C++."""

import math
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from device_port import COMPILERS, FIRMWARE, program
from helpers_firmware import EXPONENTIALS
from host_runs import SOFT, Recorded
from simulated import needs_device, own_cache  # noqa: F401

from hilbo.device.failures import DeviceError
from hilbo.device.local.library import Fate, HostRenderer, K0_of
from hilbo.device.local.motor import MOTOR
from hilbo.errors import InputError

pytestmark = needs_device
NAN = math.nan
TOO_STIFF = {"K0": 0.1, "K1": 30.0, "B1": 30.0, "alpha": 0.3}
EXACT = replace(MOTOR, latency_us=0, delay_us=0)


def test_start_is_refused_until_the_newest_set_is_in_force():
    run = Recorded(MOTOR)
    run.order("beat")
    run.tick(-1.0)
    with pytest.raises(DeviceError, match="There is no set in force"):
        run.renderer.start(run.state.stops)
    run.set(**SOFT)
    with pytest.raises(DeviceError, match="needs up to 128 more ticks"):
        run.renderer.start(run.state.stops)
    run.follow([-1.0] * 130)
    with pytest.raises(InputError, match=r"needs 1\d.* N.s/m of damping and the device has 0.95"):
        run.renderer.set(**TOO_STIFF)
    with pytest.raises(DeviceError, match="newest set was refused"):
        run.renderer.start(run.state.stops)
    run.set(**SOFT)
    run.follow([-1.0] * 130)
    with pytest.raises(DeviceError, match="There has been a stop since"):
        run.renderer.start(run.state.stops - 1)
    for _ in range(260):
        run.tick(-1.0)
    with pytest.raises(DeviceError, match="no heartbeat for too long"):
        run.renderer.start(run.state.stops)


def test_a_set_that_the_delay_makes_active_is_refused_when_it_has_been_checked():
    run = Recorded(replace(MOTOR, damping_N_s_per_m=0.5))
    run.set(K0=0.0, K1=0.55, B1=0.5, alpha=0.3)
    run.follow([-1.0] * 130)
    assert run.state.set == Fate.REFUSED and "N.s/m of damping and the device has 0.5" in run.renderer.sentence()
    without = Recorded(replace(EXACT, damping_N_s_per_m=0.5))
    without.go(K0=0.0, K1=0.55, B1=0.5, alpha=0.3)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"K0": 65.0}, "K0 is 65 N/mm, beyond the device's limit of 64"),
        ({"K1": 1e-4}, "K1 is 0.0001 N/mm, beyond the device's limit of 0.001"),
        ({"B1": 100.0}, "B1 is 100 N.s.alpha/mm, beyond the device's limit of 64"),
        ({"alpha": 0.999}, "alpha is 0.999, beyond the device's limit of 0.995"),
        ({"alpha": NAN}, "not finite"),
        ({"K0": 1e300}, "not finite"),
        ({"N": 100}, "N is even"),
        ({"N": 257}, "has length 257, the device takes 1 to 255"),
        ({"N": 0}, "has length 0, the device takes 1 to 255"),
        ({"N": 10**6}, "has length 65535, the device takes 1 to 255"),
        ({"K0": -5.0}, r"static stiffness H\(1\) is -4\.\d+ N/mm"),
        ({"force_limit": 21.0}, "force limit is 21 N; the device allows above 0 and up to 20"),
        ({"exponentials": EXPONENTIALS[:5]}, "exponentials of full memory are out of range or order"),
        ({"exponentials": EXPONENTIALS * 2}, "a set has at most 12"),
    ],
)
def test_sets_are_refused_in_a_sentence(changed, words):
    with HostRenderer(MOTOR) as renderer, pytest.raises(InputError, match=words):
        renderer.set(**SOFT | changed)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"simulated": False, "delay_us": 0, "latency_us": 0}, "above 0 on a device that is not simulated"),
        ({"latency_us": 1001}, "at most one period|at least latency_us"),
        ({"delay_us": 1001}, "at most one period"),
        ({"tick_rate_Hz": 99}, "tick_rate_Hz must be 100 to 10000"),
        ({"tick_rate_Hz": 70_000}, "tick_rate_Hz must be 100 to 10000"),
        ({"damping_N_s_per_m": NAN}, "damping must be 0.001 to 1000"),
        ({"force_limit_N": 101.0}, "force limit at most 100 N"),
        ({"position_high_mm": 33.0}, "within 32767 steps"),
        ({"continuous_force_N": 21.0}, "continuous_force_N must be above 0"),
        ({"K1_N_per_mm": (0.0, 1.0)}, "Each parameter range"),
        ({"watchdog_ticks": -1}, "must be at least 0"),
    ],
)
def test_numbers_of_a_device_are_refused_in_a_sentence(changed, words):
    with pytest.raises(InputError, match=words):
        HostRenderer(replace(MOTOR, **changed))


@pytest.mark.parametrize(("N", "alpha"), [(1, 0.5), (25, 0.2), (101, 0.3), (255, 0.9)])
def test_k0_of_an_effective_stiffness(N, alpha):
    pot = 3.0 * 1e-3**-alpha * np.prod(1 - alpha / np.arange(1, N + 1))
    wanted = 0.44 - 5.0 * pot / (5.0 + pot)
    assert K0_of(K_eff=0.44, K1=5.0, B1=3.0, alpha=alpha, N=N) == pytest.approx(wanted, abs=1e-5)


@pytest.mark.parametrize(("N", "words"), [(101.0, "N is 101.0; it must be"), ("101", "whole"), (-1, "at least 0")])
def test_a_number_of_taps_that_is_none_is_refused(N, words):
    with pytest.raises(InputError, match=words):
        K0_of(K_eff=0.44, K1=5.0, B1=3.0, alpha=0.3, N=N)


NORMAL = """
#include "hilbo_renderer.h"
#include <cmath>
int main() {
  const double normal[3] = {0.0, 0.6, 0.8}, surface[3] = {1.0, 2.0, 3.0}, velocity[3] = {9.0, -6.0, -8.0};
  const double at[3] = {5.0, 2.0 - 0.6 * 2.5, 3.0 - 0.8 * 2.5};
  double force[3];
  hilbo_force_vector(2.0, normal, force);
  const bool right = std::fabs(hilbo_penetration_mm(at, surface, normal) - 2.5) < 1e-12 &&
                     std::fabs(hilbo_speed_mm_per_s(velocity, normal) - 10.0) < 1e-12 && force[0] == 0.0 &&
                     force[1] == 1.2 && force[2] == 1.6;
  const char *why = nullptr;
  hilbo_device_numbers numbers = hilbo_device_numbers();
  return right && hilbo_open(&numbers, &why) == nullptr && why[0] == 'T' ? 0 : 1;
}
"""


@pytest.mark.deep
@pytest.mark.parametrize("compiler", COMPILERS)
def test_the_header_is_c_plus_plus_and_the_geometry_right(compiler, tmp_path):
    library = program("libhilbo_renderer.so", compiler)
    (tmp_path / "normal.cpp").write_text(NORMAL)
    command = ["g++", "-std=c++11", "-Wall", "-Wextra", "-pedantic", "-Werror", f"-I{FIRMWARE}/port/library"]
    command += [str(tmp_path / "normal.cpp"), str(library), f"-Wl,-rpath,{library.parent}", "-o", str(tmp_path / "run")]
    subprocess.run(command, check=True)
    assert subprocess.run([str(tmp_path / "run")]).returncode == 0
    listed = subprocess.run(["nm", "-D", "--defined-only", str(library)], capture_output=True, text=True, check=True)
    assert all(line.split()[-1].startswith("hilbo_") for line in listed.stdout.splitlines())
