"""Old place of what ``newton_qd.qd`` has."""

from __future__ import annotations

from typing import Any

from newton_qd.moved import moved_name

_MOVED = {
    "from_ribs": "newton_qd.qd.from_ribs",
    "make_ribs_evaluation": "newton_qd.qd.make_ribs_evaluation",
    "to_ribs": "newton_qd.qd.to_ribs",
}


def __getattr__(name: str) -> Any:
    """Finds an old name in its new place."""
    return moved_name(__name__, name, _MOVED)
