"""Old place of what ``newton_qd.qd.algorithms`` has."""

from __future__ import annotations

from typing import Any

from newton_qd.moved import moved_name

_MOVED = {
    "TUNED": "newton_qd.qd.algorithms.gradient_options.TUNED",
}


def __getattr__(name: str) -> Any:
    """Finds an old name in its new place."""
    return moved_name(__name__, name, _MOVED)
