"""Wrappers: each adds one thing to an environment."""

from newton_qd.wrappers.auto_reset import AutoResetWrapper
from newton_qd.wrappers.base import Wrapper
from newton_qd.wrappers.clip_reward import ClipRewardWrapper
from newton_qd.wrappers.completed_eval import (
    CompletedEvalMetrics,
    CompletedEvalWrapper,
)
from newton_qd.wrappers.descriptor import DescriptorWrapper
from newton_qd.wrappers.episode import EpisodeWrapper
from newton_qd.wrappers.evaluation import EvalMetrics, EvalWrapper
from newton_qd.wrappers.feet_contact import FeetContactWrapper
from newton_qd.wrappers.fixed_initial_state import FixedInitialStateWrapper
from newton_qd.wrappers.maze import MazeWrapper
from newton_qd.wrappers.no_forward_reward import NoForwardRewardWrapper
from newton_qd.wrappers.offset_reward import OffsetRewardWrapper
from newton_qd.wrappers.qd import QDWrapper
from newton_qd.wrappers.random_params import RandomParamsWrapper
from newton_qd.wrappers.state_descriptor_reset import StateDescriptorResetWrapper
from newton_qd.wrappers.trap import TrapWrapper
from newton_qd.wrappers.vector import VectorWrapper
from newton_qd.wrappers.xy_position import XYPositionWrapper

__all__ = [
    "AutoResetWrapper",
    "ClipRewardWrapper",
    "CompletedEvalMetrics",
    "CompletedEvalWrapper",
    "DescriptorWrapper",
    "EpisodeWrapper",
    "EvalMetrics",
    "EvalWrapper",
    "FeetContactWrapper",
    "FixedInitialStateWrapper",
    "MazeWrapper",
    "NoForwardRewardWrapper",
    "OffsetRewardWrapper",
    "QDWrapper",
    "RandomParamsWrapper",
    "StateDescriptorResetWrapper",
    "TrapWrapper",
    "VectorWrapper",
    "Wrapper",
    "XYPositionWrapper",
]
