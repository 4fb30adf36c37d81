"""Old place of names that are now in ``newton_qd.qd``."""

from __future__ import annotations

from typing import Any

from newton_qd.moved import moved_name

_MOVED = {
    "device_mesh": "newton_qd.qd.device_mesh",
    "shard_scoring": "newton_qd.qd.shard_scoring",
    "AXIS": "newton_qd.qd.scoring.sharding.AXIS",
    "on_mesh": "newton_qd.qd.scoring.sharding.on_mesh",
}


def __getattr__(name: str) -> Any:
    """Returns a moved object by its old name."""
    return moved_name(__name__, name, _MOVED)
