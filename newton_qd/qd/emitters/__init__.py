"""Emitters for QDax. All but ``AsciiEmitter`` use exact gradients.

- ``ActorCriticEmitter``: policies of actors that learn over short windows with
  ``ActorCritic``, and then from whole episodes with ``EpisodeLearning``
- ``ConditionedActorEmitter``: policies of one such actor that is told the descriptor
- ``AscentEmitter``: elites that climb along the gradient of their return, step by step
- ``AsciiEmitter``: parents move towards the better actions of other individuals
- ``ExactAsciiEmitter``: the same with the gradient of the physics
- ``OMGMEGAEmitter``: random steps along the gradients of elites
- ``CMAMEGAEmitter``: CMA-ES searches for the steps along the gradients of a solution
  point
- ``CMAMAEGAEmitter``: the same with an annealed archive, ``AnnealedRepertoire``
- ``WindowArborescenceEmitter``: the same for large policies, with actors that find the
  gradients over short windows
- ``GradientLineEmitter``: several offspring along one gradient of each parent
- ``GradientVariationEmitter``: elites climb their fitness, or move along descriptors
- ``SteeringEmitter``: elites move towards empty cells

The emitters with actors, ``AscentEmitter``, ``ExactAsciiEmitter`` and
``GradientLineEmitter`` evaluate gradients themselves. ``AsciiEmitter`` reads
``extra_scores["transitions"]``. All others read ``extra_scores["gradients"]``, see
``scoring/gradient_scores.py``. All emitters work with ``jax.jit`` and ``jax.lax.scan``,
and together with QDax's emitters in its ``MultiEmitter``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from newton_qd.errors import require_extra
from newton_qd.lazy import loaded_name

if TYPE_CHECKING:
    from newton_qd.qd.emitters.actor_critic import ActorCriticEmitter
    from newton_qd.qd.emitters.actor_critic_learner import ActorCritic
    from newton_qd.qd.emitters.actor_critic_settings import ActorCriticSettings
    from newton_qd.qd.emitters.ascent import AscentEmitter
    from newton_qd.qd.emitters.ascii import AsciiEmitter, ExactAsciiEmitter
    from newton_qd.qd.emitters.behaviors import Interpolation
    from newton_qd.qd.emitters.cma_maega import CMAMAEGAEmitter
    from newton_qd.qd.emitters.cma_mega import CMAMEGAEmitter
    from newton_qd.qd.emitters.conditioned import ConditionedActorEmitter
    from newton_qd.qd.emitters.episode_learner import EpisodeLearning
    from newton_qd.qd.emitters.gradient_line import GradientLineEmitter
    from newton_qd.qd.emitters.gradient_variation import GradientVariationEmitter
    from newton_qd.qd.emitters.omg_mega import OMGMEGAEmitter
    from newton_qd.qd.emitters.restarts import RestartRule
    from newton_qd.qd.emitters.steering import SteeringEmitter
    from newton_qd.qd.emitters.window_arborescence import WindowArborescenceEmitter
    from newton_qd.qd.scoring.gradient_scores import GradientsError

__all__ = [
    "ActorCritic",
    "ActorCriticEmitter",
    "ActorCriticSettings",
    "AscentEmitter",
    "AsciiEmitter",
    "CMAMAEGAEmitter",
    "CMAMEGAEmitter",
    "ConditionedActorEmitter",
    "EpisodeLearning",
    "ExactAsciiEmitter",
    "GradientLineEmitter",
    "GradientVariationEmitter",
    "GradientsError",
    "Interpolation",
    "OMGMEGAEmitter",
    "RestartRule",
    "SteeringEmitter",
    "WindowArborescenceEmitter",
]

_HOME = {
    "ActorCritic": ".actor_critic_learner",
    "ActorCriticEmitter": ".actor_critic",
    "ActorCriticSettings": ".actor_critic_settings",
    "AscentEmitter": ".ascent",
    "AsciiEmitter": ".ascii",
    "CMAMAEGAEmitter": ".cma_maega",
    "CMAMEGAEmitter": ".cma_mega",
    "ConditionedActorEmitter": ".conditioned",
    "EpisodeLearning": ".episode_learner",
    "ExactAsciiEmitter": ".ascii",
    "GradientLineEmitter": ".gradient_line",
    "GradientVariationEmitter": ".gradient_variation",
    "GradientsError": "..scoring.gradient_scores",
    "Interpolation": ".behaviors",
    "OMGMEGAEmitter": ".omg_mega",
    "RestartRule": ".restarts",
    "SteeringEmitter": ".steering",
    "WindowArborescenceEmitter": ".window_arborescence",
}


def __getattr__(name: str) -> Any:
    """Loads a name of this package when it is first used."""
    if name in _HOME:
        require_extra("qdax", "qd")
    return loaded_name(globals(), name, _HOME)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
