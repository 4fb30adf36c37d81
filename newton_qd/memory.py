"""Memory of this machine, to refuse sizes that cannot fit before anything allocates.

Without this, the kernel of Linux ends the process, and says nothing.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from newton_qd.checks import Error, message

# Limits of a container [bytes], of both versions of Linux's control groups.
_CONTAINER = (
    Path("/sys/fs/cgroup/memory.max"),
    Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"),
)


def limit(device: Any = None) -> int | None:
    """Returns the memory that a device has [bytes], or ``None`` if nobody says.

    Args:
        device: JAX device; ``None``: the host.
    """
    if device is not None and device.platform != "cpu":
        return (device.memory_stats() or {}).get("bytes_limit")
    found = []
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    for path in _CONTAINER:
        try:
            text = path.read_text(encoding="ascii").strip()
        except OSError:
            continue
        if text.isdecimal():
            found.append(int(text))
    return min(found, default=None)


def limit_here() -> int | None:
    """Returns the memory [bytes] of the device on which JAX makes new arrays.

    Within ``jax.default_device(...)``, it may be another one than JAX's own choice.
    ``None``: nobody says.
    """
    import jax

    with jax.ensure_compile_time_eval():  # also while a function is traced
        (device,) = jax.device_put(0.0).devices()
    return limit(device)


def check(
    name: str, value: object, needed: int, most: int | None, error: Error = ValueError
) -> None:
    """Checks that something can fit in memory.

    Args:
        name: Name of the argument, or of several.
        value: Its value.
        needed: Memory that it needs at least [bytes].
        most: Memory that there is [bytes]; ``None``: unknown.
        error: Class to raise instead.

    Raises:
        ValueError: It cannot.
    """
    if most is None or needed <= most:
        return
    allowed = f"sizes that fit in the {_shown(most)} of memory here"
    why = f"which needs at least {_shown(needed)}"
    raise error(message(name, value, allowed, why=why))


def _shown(size: int) -> str:
    for unit in ("bytes", "kB", "MB", "GB", "TB"):
        if size < 1000 or unit == "TB":
            break
        size /= 1000  # type: ignore[assignment]
    return f"{size:,.3g} {unit}" if size < 1000 else f"{size:,.0f} {unit}"
