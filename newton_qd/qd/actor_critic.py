"""Old place of names that are now in ``newton_qd.qd.emitters``."""

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
    """Returns a moved object by its old name."""
    return moved_name(__name__, name, _MOVED)
