"""Old place of what ``newton_qd.qd.emitters`` has."""

from __future__ import annotations

from typing import Any

from newton_qd.moved import moved_name

_MOVED = {
    "ActorCritic": "newton_qd.qd.emitters.ActorCritic",
    "ActorCriticSettings": "newton_qd.qd.emitters.ActorCriticSettings",
    "Learner": "newton_qd.qd.emitters.actor_critic_learner.Learner",
    "measure_of": "newton_qd.qd.emitters.actor_critic_learner.measure_of",
}


def __getattr__(name: str) -> Any:
    """Finds an old name in its new place."""
    return moved_name(__name__, name, _MOVED)
