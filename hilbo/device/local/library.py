"""The firmware's core in this process, for a program that closes the control loop itself: `HostRenderer`, by ctypes.

    with HostRenderer(numbers) as renderer:
        renderer.set(K0=0.1, K1=0.6, B1=0.5, alpha=0.3)
        while True:                                              # each period, in a separate thread
            force = renderer.tick(position, velocity, time.perf_counter())

It is `libhilbo_renderer`, compiled once with the C compiler of this computer; firmware/port/library/hilbo_renderer.h
has its rules. The library computes forces and the program drives the motor: if the program hangs or is killed, the
device itself must react (docs/device/host-port.md). Python at 1 kHz is for simulated devices and for tests: a garbage
collection or another thread may cost a tick, which is a HOLD.
"""

import ctypes
import math
import operator
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any, NamedTuple, SupportsIndex

from hilbo.device.failures import DeviceError
from hilbo.device.local.compiled import compiled
from hilbo.device.reasons import State
from hilbo.errors import InputError

__all__ = ["DeviceNumbers", "Fate", "HostRenderer", "HostState", "K0_of", "library"]

_SOURCES = ("core/*.c", *(f"port/library/{name}.c" for name in ("hilbo_renderer", "orders", "schedule", "sentences")))
_MOST_EXPONENTIALS = 12
_ROOM = 256  # bytes for a sentence


class Fate:
    """Status of the parameter set given last."""

    NONE, WAITING, IN_FORCE, REFUSED = range(4)


@dataclass(frozen=True, kw_only=True)
class DeviceNumbers:
    """Properties of the device; struct hilbo_device_numbers in hilbo_renderer.h documents each number."""

    simulated: bool = False
    passivity_controller: bool = False
    tick_rate_Hz: int = 1000
    latency_us: int
    delay_us: int
    watchdog_ticks: int = 250
    hold_ticks: int = 20
    damping_N_s_per_m: float
    force_limit_N: float
    continuous_force_N: float
    heating_s: float
    position_low_mm: float
    position_high_mm: float
    position_step_mm: float
    slew_limit_N_per_s: float
    velocity_limit_mm_per_s: float
    plausible_step_mm: float
    K0_N_per_mm: tuple[float, float] = (-64.0, 64.0)
    K1_N_per_mm: tuple[float, float] = (1e-3, 64.0)
    B1_N_s_alpha_per_mm: tuple[float, float] = (1e-4, 64.0)
    alpha: tuple[float, float] = (0.005, 0.995)


class HostState(NamedTuple):
    """State of a renderer; struct hilbo_state in hilbo_renderer.h documents each number."""

    state: int
    cause: int
    stops: int
    set: int
    wait_ticks: int
    contact: int
    ticks: int
    missed: int
    early: int
    late_us: int
    latest_us: int
    time_s: float
    position_mm: float
    force_N: float
    minimum_damping_N_s_per_m: float
    input_held: int
    saturated: int
    slewed: int
    controlled: int
    holds: int
    estops: int
    overruns: int


class _Range(ctypes.Structure):
    _fields_ = (("low", ctypes.c_double), ("high", ctypes.c_double))


_C_TYPES = {bool: ctypes.c_uint32, int: ctypes.c_uint32, float: ctypes.c_double}


class _Numbers(ctypes.Structure):
    _fields_ = (
        ("size", ctypes.c_uint32),
        *((name, _C_TYPES.get(kind, _Range)) for name, kind in DeviceNumbers.__annotations__.items()),
    )


class _Set(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_double) for name in ("K0", "K1", "B1", "alpha", "force_limit")),
        ("taps", ctypes.c_uint32),
        ("exponentials", ctypes.c_uint32),
        ("weight", ctypes.c_double * _MOST_EXPONENTIALS),
        ("loss", ctypes.c_double * _MOST_EXPONENTIALS),
    )


class _State(ctypes.Structure):
    _fields_ = tuple((name, _C_TYPES[kind]) for name, kind in HostState.__annotations__.items())


@cache
def library() -> ctypes.CDLL:
    """Load the shared library, compiled first if it is not in the cache, and declare the types of its functions.
    Repeated calls return the same object. Raises `DeviceError` if it cannot be built."""
    path = compiled("libhilbo_renderer.so", "the renderer library", ("core", "port/library"), _SOURCES, shared=True)
    lib = ctypes.CDLL(str(path))
    handle, u32, double = ctypes.c_void_p, ctypes.c_uint32, ctypes.c_double
    signatures: dict[str, tuple[Any, list[Any]]] = {
        "open": (handle, [ctypes.POINTER(_Numbers), ctypes.POINTER(ctypes.c_char_p)]),
        "close": (None, [handle]),
        "set": (ctypes.c_int, [handle, ctypes.POINTER(_Set)]),
        "start": (ctypes.c_int, [handle, u32]),
        "clear": (ctypes.c_int, [handle, u32]),
        "stop": (None, [handle]),
        "estop": (None, [handle]),
        "heartbeat": (None, [handle]),
        "tick": (double, [handle, double, double, double]),
        "get_state": (None, [handle, ctypes.POINTER(_State)]),
        "sentence": (None, [handle, ctypes.c_char_p, ctypes.c_size_t]),
        "cause_in_words": (ctypes.c_char_p, [u32]),
        "K0_of": (double, [ctypes.POINTER(_Set), u32, double]),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(lib, f"hilbo_{name}")
        function.restype, function.argtypes = result, arguments
    return lib


class HostRenderer:
    """Renderer in this process, initially STOPPED and without a set. Raises `InputError` for numbers out of range.

    Every method may be called from any thread, `tick` from one only.
    """

    def __init__(self, numbers: DeviceNumbers):
        self._lib, self.numbers = library(), numbers
        given = {
            name: _Range(*value) if isinstance(value, tuple) else _fits_u32(value)
            for name, value in asdict(numbers).items()
        }
        why = ctypes.c_char_p()
        packed = _Numbers(size=ctypes.sizeof(_Numbers), **given)
        self._handle = self._lib.hilbo_open(ctypes.byref(packed), ctypes.byref(why))
        if not self._handle:
            raise InputError((why.value or b"").decode())
        self._tick = self._lib.hilbo_tick

    def __enter__(self) -> "HostRenderer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Free the renderer, while no other call runs. No method may be called after it."""
        handle, self._handle = self._handle, None
        self._lib.hilbo_close(handle)

    def set(
        self,
        *,
        K0: float,
        K1: float,
        B1: float,
        alpha: float,
        N: int = 101,
        exponentials: Sequence[tuple[float, float]] = (),
        force_limit: float | None = None,
    ) -> None:
        """Check a parameter set and stage it; it becomes active at the first tick that allows it (`state().set`).

        Units: N/mm, N·s^α/mm, N. `exponentials`: (weight, loss) pairs of full memory, instead of N. `force_limit`: None
        for the device's. Raises `InputError` for a set that the library refuses.
        """
        limit = self.numbers.force_limit_N if force_limit is None else force_limit
        packed = _packed(K0, K1, B1, alpha, N, exponentials, limit)
        if self._lib.hilbo_set(self._handle, ctypes.byref(packed)):
            raise InputError(self.sentence())

    def start(self, stops: int) -> None:
        """Start rendering, from out of contact; `stops`: the count of stops in the `state()` that the caller has
        inspected.

        Raises `DeviceError` if the library refuses, such as after another stop.
        """
        if self._lib.hilbo_start(self._handle, stops):
            raise DeviceError(self.sentence())

    def clear(self, stops: int) -> None:
        """Change from HOLD or ESTOP to STOPPED; `stops`: the count of stops in the `state()` that the caller has
        inspected. Raises `DeviceError` if the library refuses, such as after another stop."""
        if self._lib.hilbo_clear(self._handle, stops):
            raise DeviceError(self.sentence())

    def stop(self) -> None:
        """Ramp the force to zero within `hold_ticks`; the state is then STOPPED."""
        self._lib.hilbo_stop(self._handle)

    def estop(self) -> None:
        """Emergency stop: force zero at the next tick, and state ESTOP until `clear`."""
        self._lib.hilbo_estop(self._handle)

    def heartbeat(self) -> None:
        """Report that the controlling thread is alive; at least every `watchdog_ticks`, better three times as often."""
        self._lib.hilbo_heartbeat(self._handle)

    def tick(self, position_mm: float, velocity_mm_per_s: float, time_s: float) -> float:
        """Advance the renderer by one period and return the force (N) to output, given position, velocity and time (s);
        NaN for a quantity that the device does not provide."""
        return self._tick(self._handle, position_mm, velocity_mm_per_s, time_s)

    def state(self) -> HostState:
        """Current state, read from the library."""
        packed = _State()
        self._lib.hilbo_get_state(self._handle, ctypes.byref(packed))
        return HostState(*(getattr(packed, name) for name in HostState._fields))

    def sentence(self) -> str:
        """Message of the library about the last refusal."""
        text = ctypes.create_string_buffer(_ROOM)
        self._lib.hilbo_sentence(self._handle, text, _ROOM)
        return text.value.decode()

    def why(self) -> str:
        """Current state and its cause in words, such as "HOLD: …"."""
        now = self.state()
        return f"{State(now.state).name}: {self._lib.hilbo_cause_in_words(now.cause).decode()}"


def K0_of(*, K_eff: float, K1: float, B1: float, alpha: float, N: int = 101, tick_rate_Hz: int = 1000) -> float:
    """Compute the K0 (N/mm) with which a short-memory set of N samples has the static stiffness K_eff (N/mm).

    Raises `InputError` for an N that is no integer or does not fit 32 unsigned bits, `DeviceError` if the library
    cannot be built.
    """
    packed = _packed(0.0, K1, B1, alpha, N, (), math.nan)
    return library().hilbo_K0_of(ctypes.byref(packed), tick_rate_Hz, K_eff)


def _packed(K0: float, K1: float, B1: float, alpha: float, N: int, exponentials: Any, limit: float) -> _Set:
    """Build the C struct of a parameter set; N is ignored if there are exponentials, (weight, loss) pairs.

    Raises `InputError` for too many exponentials, or an N that is no integer or does not fit 32 unsigned bits.
    """
    if len(exponentials) > _MOST_EXPONENTIALS:
        raise InputError(f"There are {len(exponentials)} exponentials; a set has at most {_MOST_EXPONENTIALS}.")
    packed = _Set(K0, K1, B1, alpha, limit, 0 if exponentials else _taps(N), len(exponentials))
    for k, (weight, loss) in enumerate(exponentials):
        packed.weight[k], packed.loss[k] = weight, loss
    return packed


def _taps(N: int) -> int:
    """Return N. Raises `InputError` if it is no integer, or does not fit 32 unsigned bits."""
    if not isinstance(N, SupportsIndex):
        raise InputError(f"N is {N!r}; it must be a whole number.")
    return _fits_u32(operator.index(N))


def _fits_u32(value: Any) -> Any:
    """Return the value unchanged. Raises `InputError` for an integer that does not fit 32 unsigned bits."""
    if isinstance(value, int) and not 0 <= value < 2**32:
        raise InputError(f"{value} must be at least 0 and below 2^32.")
    return value
