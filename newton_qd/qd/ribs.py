"""Old place of names that are now in ``newton_qd.qd``."""

from __future__ import annotations

from typing import Any

from newton_qd.moved import moved_name

_MOVED = {
    "from_ribs": "newton_qd.qd.from_ribs",
    "make_ribs_evaluation": "newton_qd.qd.make_ribs_evaluation",
    "to_ribs": "newton_qd.qd.to_ribs",
}


def __getattr__(name: str) -> Any:
    """Returns a moved object by its old name."""
    return moved_name(__name__, name, _MOVED)
