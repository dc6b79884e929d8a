"""The text that the commands of `hilbo device` print of devices, parameter sets and frames of a capture."""

from typing import Any

__all__ = ["condition_words", "decoded", "said", "set_words"]


def said(name: str, value: Any) -> str:
    """A field of the answer to HELLO as text; hashes and ids in hexadecimal."""
    if name in ("schema", "firmware", "boot_id"):
        return f"{value:08x}"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def condition_words(condition) -> str:
    """Homed or not, hardware stop, delay and continuous force of a device (`Condition`), a line each."""
    rows = {
        "homed": "yes" if condition.homed else "no; set its position with `hilbo device home`",
        "hardware stop": "open" if condition.stop_open else "closed",
        "delay": f"sets are checked for {condition.delay_us} us; the longest since its start was"
        f" {condition.longest_delay_us} us",
        "continuous force": f"{condition.continuous_force_N:.6g} N (root mean square over {condition.heating_s:.6g} s)",
    }
    return "\n".join(f"{name:26} {words}" for name, words in rows.items())


def set_words(current) -> str:
    """An active set (`InForce`) in a line, with units."""
    length = f"N = {current.length}" if current.memory == "short" else f"full memory, {current.length} exponentials"
    return (
        f"K0 = {current.K0:.6g}, K1 = {current.K1:.6g} N/mm, B1 = {current.B1:.6g} N.s^alpha/mm,"
        f" alpha = {current.alpha:.6g}, {length}; at most {current.force_limit:.4g} N; needs {current.needs:.4g} N.s/m"
    )


def decoded(row: dict[str, Any]) -> str:
    """A frame of a capture as a line: its first byte, its number, its message or the error. `row`: as `hilbo device
    decode` prints it with --json."""
    seq = "  -" if row["seq"] is None else f"{row['seq']:3}"
    if row["message"] is None:
        return f"{row['byte']:8} {seq}  ?  {row['wrong']}"
    fields = "  ".join(f"{name}={_field(value)}" for name, value in row["fields"].items() if name != "reserved")
    return f"{row['byte']:8} {seq}  {row['message']:12} {fields}"


def _field(value: Any) -> str:
    """A value of a message as text; tuples as groups in parentheses."""
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float):
        return f"{value:.7g}"
    if isinstance(value, tuple | list):
        return " ".join(f"({','.join(map(_field, row))})" for row in value)
    return str(value)
