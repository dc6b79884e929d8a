"""What devices say, in words for a terminal: what they are, their sets, and captured messages."""

__all__ = ["decoded", "said", "set_words"]


def said(name, value) -> str:
    if name in ("schema", "firmware", "boot_id"):
        return f"{value:08x}"
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def set_words(found) -> str:
    length = f"N = {found.length}" if found.memory == "short" else f"full memory, {found.length} exponentials"
    return (
        f"K0 = {found.K0:.6g}, K1 = {found.K1:.6g} N/mm, B1 = {found.B1:.6g} N.s^alpha/mm, alpha = {found.alpha:.6g},"
        f" {length}; at most {found.force_limit:.4g} N; needs {found.needs:.4g} N.s/m"
    )


def decoded(row) -> str:
    seq = "  -" if row["seq"] is None else f"{row['seq']:3}"
    if row["message"] is None:
        return f"{row['byte']:8} {seq}  ?  {row['wrong']}"
    fields = "  ".join(f"{name}={_field(value)}" for name, value in row["fields"].items() if name != "reserved")
    return f"{row['byte']:8} {seq}  {row['message']:12} {fields}"


def _field(value) -> str:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, float):
        return f"{value:.7g}"
    return (
        " ".join(f"({','.join(map(_field, row))})" for row in value) if isinstance(value, tuple | list) else str(value)
    )
