"""Old place of what ``newton_qd.qd`` has."""

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
    """Finds an old name in its new place."""
    return moved_name(__name__, name, _MOVED)
