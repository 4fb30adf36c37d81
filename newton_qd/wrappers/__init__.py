"""Wrappers: each adds one thing to an environment."""

from newton_qd.wrappers.auto_reset import AutoResetWrapper
from newton_qd.wrappers.base import Wrapper
from newton_qd.wrappers.completed_eval import (
    CompletedEvalMetrics,
    CompletedEvalWrapper,
)
from newton_qd.wrappers.episode import EpisodeWrapper
from newton_qd.wrappers.evaluation import EvalMetrics, EvalWrapper
from newton_qd.wrappers.feet_contact import FeetContactWrapper
from newton_qd.wrappers.fixed_initial_state import FixedInitialStateWrapper
from newton_qd.wrappers.state_descriptor_reset import StateDescriptorResetWrapper
from newton_qd.wrappers.vector import VectorWrapper

__all__ = [
    "AutoResetWrapper",
    "CompletedEvalMetrics",
    "CompletedEvalWrapper",
    "EpisodeWrapper",
    "EvalMetrics",
    "EvalWrapper",
    "FeetContactWrapper",
    "FixedInitialStateWrapper",
    "StateDescriptorResetWrapper",
    "VectorWrapper",
    "Wrapper",
]
