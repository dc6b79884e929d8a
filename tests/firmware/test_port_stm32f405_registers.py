"""The STM32F405 port on a model of the chip's registers: clock, pins, line, counter, output, watchdog, flash.

What the model knows is what the reference manual says; a chip has never been asked.
"""

import ctypes
import subprocess

import numpy as np
import pytest
from helpers_firmware import CORE, FIRMWARE, compiler

TWO_PWM, PWM_AND_SIGN, DAC = range(3)
PORT = FIRMWARE / "port" / "stm32f405"
RCC, FLASH, GPIO, IWDG, SYSTICK = 0x40023800, 0x40023C00, (0x40020000, 0x40020400), 0x40003000, 0xE000E010
TIM1, TIM3, TIM5, USART1, DAC_1 = 0x40010000, 0x40000400, 0x40000C00, 0x40011000, 0x40007400
CRYSTAL_HZ, PWM_HZ, FULL_SCALE_N = 8_000_000, 20_000, 10.0
DRIVER = 12  # pin of port B


class Chip:
    """The port in this process, on a chip that has just been reset."""

    def __init__(self, library: ctypes.CDLL, crystal_works: bool = True):
        self.library = library
        library.model_reset(int(crystal_works))

    def __getattr__(self, name: str):
        return getattr(self.library, f"model_{name}")

    def start(self, output=TWO_PWM, motor_sign=1, crystal_Hz=CRYSTAL_HZ, pwm_Hz=PWM_HZ, full_scale_N=FULL_SCALE_N):
        sentence = self.library.model_start(output, motor_sign, crystal_Hz, pwm_Hz, ctypes.c_float(full_scale_N))
        return sentence and sentence.decode()

    def field(self, address: int, low: int, bits: int) -> int:
        return self.read(address) >> low & (1 << bits) - 1

    def mode(self, port: int, pin: int) -> int:
        return self.field(GPIO[port], 2 * pin, 2)

    def function(self, port: int, pin: int) -> int:
        assert self.mode(port, pin) == 2
        return self.field(GPIO[port] + 0x20 + 4 * (pin // 8), 4 * (pin % 8), 4)

    def out(self, force_N: float) -> None:
        self.library.model_output(ctypes.c_float(force_N))

    def duties(self) -> tuple[float, float]:
        """Shares of the period in which PA8 and PA9 are high, while the main output is on."""
        period = self.read(TIM1 + 0x2C) + 1
        assert self.field(TIM1 + 0x44, 15, 1) == 1
        return self.read(TIM1 + 0x34) / period, self.read(TIM1 + 0x38) / period

    def driver(self) -> int:
        return self.pins(1) >> DRIVER & 1


@pytest.fixture(scope="module")
def library(tmp_path_factory) -> ctypes.CDLL:
    target = tmp_path_factory.mktemp("stm32f405") / "model.so"
    sources = [FIRMWARE / "tests" / "stm32f405_model.c", CORE / "hb_config.c"]
    sources += [PORT / f"{name}.c" for name in ("board_real", "boot_id", "settings", "uart")]
    folders = [CORE, FIRMWARE / "port" / "arm", PORT, PORT / "config"]
    command = [compiler(), "-std=c11", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-DREGISTER_MODEL"]
    command += ["-shared", "-fPIC", *(f"-I{folder}" for folder in folders), *sources, "-o", target, "-lm"]
    subprocess.run(list(map(str, command)), check=True)
    library = ctypes.CDLL(str(target))
    for name in ("read", "pins", "boot_id", "erased", "output_delay_us", "small_boot"):
        getattr(library, f"model_{name}").restype = ctypes.c_uint32
    library.model_start.restype = ctypes.c_char_p
    return library


@pytest.fixture
def chip(library) -> Chip:
    return Chip(library)


@pytest.mark.parametrize("crystal_Hz", [4_000_000, 8_000_000, 12_000_000, 16_000_000, 26_000_000])
def test_the_clock_is_168_MHz_from_any_crystal(chip, crystal_Hz):
    assert chip.start(crystal_Hz=crystal_Hz) is None
    M, N, P = chip.field(RCC + 4, 0, 6), chip.field(RCC + 4, 6, 9), 2 * chip.field(RCC + 4, 16, 2) + 2
    assert crystal_Hz / M == 2e6 and crystal_Hz / M * N / P == 168e6  # 1 to 2 MHz into the PLL
    assert chip.field(RCC + 4, 22, 1) == 1 and chip.field(RCC + 8, 2, 2) == 2  # from the crystal; and it is used
    assert (chip.field(RCC + 8, 10, 3), chip.field(RCC + 8, 13, 3)) == (0b101, 0b100)  # APB1 by 4, APB2 by 2
    assert chip.field(FLASH, 0, 3) == 5  # wait states that 168 MHz at 3.3 V needs
    assert chip.field(RCC, 19, 1) == 1  # a crystal that fails is a fault
    assert chip.read(TIM5 + 0x28) + 1 == 84  # APB1's timers run at 84 MHz: microseconds


def test_without_its_crystal_the_chip_says_so_and_gives_no_force(library):
    chip = Chip(library, crystal_works=False)
    assert "crystal" in chip.start()
    assert 16e6 / chip.read(USART1 + 8) == pytest.approx(921_600, rel=0.025)  # at the clock of the reset
    assert chip.read(TIM5 + 0x28) + 1 == 16
    assert not chip.driver_has_been_on() and chip.mode(0, 8) != 2


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"crystal_Hz": 8_500_000}, "crystal_Hz"),
        ({"crystal_Hz": 48_000_000}, "crystal_Hz"),
        ({"output": 3}, "output"),
        ({"pwm_Hz": 1000}, "pwm_Hz"),
        ({"full_scale_N": 4.0}, "full_scale_N"),
        ({"full_scale_N": float("nan")}, "full_scale_N"),
        ({"motor_sign": 0}, "motor_sign"),
    ],
)
def test_settings_that_are_refused(chip, settings, word):
    sentence = chip.start(**settings)
    assert word in sentence and sentence.endswith(".") and not chip.driver_has_been_on()


def test_the_line_has_its_rate_and_pins(chip):
    chip.start()
    assert 84e6 / chip.read(USART1 + 8) == pytest.approx(921_600, rel=0.005)
    assert (chip.function(1, 6), chip.function(1, 7)) == (7, 7)
    assert chip.read(USART1 + 12) == 1 << 13 | 1 << 5 | 1 << 3 | 1 << 2
    assert chip.read(0xE000E104) == 1 << 37 - 32


def test_bytes_go_in_and_out_in_order(chip):
    chip.start()
    for byte in b"\x00\x41\xff":
        chip.write(USART1 + 4, byte)
        chip.write(USART1, 1 << 5)  # received, and no room to send
        chip.line_interrupt()
    assert [chip.receive() for _ in range(4)] == [0x00, 0x41, 0xFF, -1]
    chip.write(USART1, 1 << 3)  # an overrun alone is no byte
    chip.line_interrupt()
    assert chip.receive() == -1
    chip.write(USART1, 0)
    chip.send(b"abc", 3)
    assert chip.field(USART1 + 12, 7, 1) == 1  # interrupts send what the line did not take
    sent = []
    chip.write(USART1, 1 << 7)
    for _ in range(3):
        chip.line_interrupt()
        sent.append(chip.read(USART1 + 4))
    assert bytes(sent) == b"abc" and chip.field(USART1 + 12, 7, 1) == 0


def test_the_encoder_counts_both_edges_of_both_signals(chip):
    chip.start()
    assert (chip.function(1, 4), chip.function(1, 5)) == (2, 2)
    assert chip.read(TIM3 + 8) == 3 and chip.read(TIM3 + 0x2C) == 0xFFFF and chip.field(TIM3, 0, 1) == 1


def test_the_counter_is_extended_beyond_its_16_bits(chip):
    steps = np.random.default_rng(3).integers(-32_768, 32_768, 2000)
    counts = 5 + np.concatenate([[0], np.cumsum(steps)])
    counters = (counts % 65_536).astype(np.uint16)
    pointer = counters.ctypes.data_as(ctypes.POINTER(ctypes.c_uint16))
    assert chip.encoder(pointer, ctypes.c_size_t(counters.size)) == counts[-1] - counts[0]


def test_the_stop_is_open_where_its_wire_is_broken(chip):
    chip.start()
    assert chip.field(GPIO[0] + 0x0C, 12, 2) == 1  # pulled up
    chip.write(GPIO[0] + 0x10, 1 << 6)
    assert chip.stop_is_open() == 1
    chip.write(GPIO[0] + 0x10, 0)
    assert chip.stop_is_open() == 0
    # The same pin is the timer's break, active high: PWM ends without software, its pins driven low.
    assert chip.function(0, 6) == 1 and chip.field(TIM1 + 0x44, 10, 4) == 0b1111


@pytest.mark.parametrize("output", [TWO_PWM, PWM_AND_SIGN, DAC])
def test_the_driver_is_off_until_the_first_force(chip, output):
    chip.start(output)
    assert chip.mode(1, DRIVER) == 1 and not chip.driver_has_been_on()
    chip.out(0.0)
    assert chip.driver() == 1
    chip.output_off()
    assert chip.driver() == 0


@pytest.mark.parametrize("motor_sign", [1, -1])
@pytest.mark.parametrize(
    ("force_N", "share"), [(0.0, 0.0), (2.5, 0.25), (-2.5, -0.25), (10.0, 1.0), (50.0, 1.0), (-1e9, -1.0), (np.nan, 0)]
)
def test_two_pwm(chip, motor_sign, force_N, share):
    chip.start(TWO_PWM, motor_sign)
    chip.out(force_N)
    share = motor_sign * share
    assert chip.duties() == (max(share, 0), max(-share, 0))
    assert 168e6 / (chip.read(TIM1 + 0x2C) + 1) == PWM_HZ and chip.output_delay_us() == 50
    assert (chip.function(0, 8), chip.function(0, 9)) == (1, 1)
    chip.output_off()
    assert chip.field(TIM1 + 0x44, 15, 1) == 0  # without waiting for the period's end


@pytest.mark.parametrize("force_N", [-10.0, -2.5, 0.0, 2.5, 10.0])
def test_pwm_and_sign(chip, force_N):
    chip.start(PWM_AND_SIGN)
    chip.out(force_N)
    assert chip.duties()[0] == abs(force_N) / 10 and (chip.pins(0) >> 9 & 1) == (force_N > 0)
    assert chip.mode(0, 9) == 1


@pytest.mark.parametrize(("force_N", "code"), [(-20.0, 1), (-10.0, 1), (0.0, 2048), (5.0, 3072), (10.0, 4095)])
def test_dac(chip, force_N, code):
    chip.start(DAC)
    assert chip.read(DAC_1 + 8) == 2048 and chip.mode(0, 4) == 3 and chip.read(DAC_1) == 1
    chip.out(force_N)
    assert chip.read(DAC_1 + 8) == code and chip.output_delay_us() == 0
    chip.output_off()
    assert chip.read(DAC_1 + 8) == 2048


def test_the_smallest_force_is_a_step_of_the_output(chip):
    chip.start(TWO_PWM)
    chip.out(10.0 / 8400)
    assert chip.read(TIM1 + 0x34) == 1


@pytest.mark.parametrize(("rate_Hz", "low_ms", "high_ms"), [(1000, 3.4, 9.5), (100, 34, 95)])
def test_ticks_and_watchdog(chip, rate_Hz, low_ms, high_ms):
    chip.start()
    chip.start_ticks(rate_Hz)
    assert 168e6 / (chip.read(SYSTICK + 4) + 1) == rate_Hz and chip.read(SYSTICK) == 7
    cycles = 4 * (chip.read(IWDG + 8) + 1)
    assert chip.read(IWDG + 4) == 0 and low_ms <= cycles / 47 and cycles / 17 <= high_ms  # of 17 to 47 kHz
    chip.write(IWDG, 0)
    chip.tick_is_over()
    assert chip.read(IWDG) == 0xAAAA


def test_boot_ids_count_the_starts(chip):
    assert [chip.boot_id() for _ in range(3)] == [1, 2, 3]
    assert (chip.erased(0), chip.erased(1)) == (0, 0)
    assert chip.field(FLASH + 16, 31, 1) == 1  # locked again


def test_a_full_sector_is_followed_by_the_other(chip):
    for i in range(16_384):
        chip.write(0x080C0000 + 8 * i, i + 1)
        chip.write(0x080C0000 + 8 * i + 4, 0xFFFFFFFF - i - 1)
    assert [chip.boot_id(), chip.boot_id()] == [16_385, 16_386]
    assert (chip.erased(0), chip.erased(1)) == (0, 1)
    assert chip.read(0x080E0000) == 16_385


def test_no_boot_id_comes_twice_whenever_the_supply_fails(chip):
    rng = np.random.default_rng(0)
    for words in (2, 4, 8):
        for _ in range(40):
            chip.small_flash(words)
            newest = 0
            for starts in range(1, 61):
                cut = int(rng.integers(-3, 3))
                found = chip.small_boot(cut)
                assert found == 0 or newest < found <= starts  # 0: this start was cut short
                assert found or cut >= 0
                newest = max(newest, found)
            assert newest > 10


def test_the_config_of_the_template_is_accepted(chip):
    assert chip.config_error() == 0
