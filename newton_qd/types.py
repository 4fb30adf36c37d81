"""Shared aliases, and the table of the keys of ``State.info``."""

from __future__ import annotations

import types
from collections.abc import Mapping
from typing import Any, TypeAlias

import jax

RNGKey: TypeAlias = jax.Array
Action: TypeAlias = jax.Array
Observation: TypeAlias = jax.Array
Descriptor: TypeAlias = jax.Array
Mask: TypeAlias = jax.Array
Metrics: TypeAlias = dict[str, jax.Array]
Info: TypeAlias = dict[str, Any]
Params: TypeAlias = Any  # of simulated robots: physics.PhysicsParams

INFO_KEYS: Mapping[str, str] = types.MappingProxyType(
    {
        "fault": "() int32: 0 while the world is sound; then frozen until it is reset",
        "steps": "() control steps since the episode began",
        "truncation": "() 1 where the episode ended by its length alone, else 0",
        "state_descriptor": "(nd,) descriptor of the state that this step reached",
        "xy_position": "(2,) x and y of the torso [m], also beyond the limits",
        "first_pipeline_state": "physics state to which an auto-reset returns",
        "first_obs": "(no,) observation to which an auto-reset returns",
        "first_state_descriptor": "(nd,) descriptor to which an auto-reset returns",
        "first_xy_position": "(2,) position to which an auto-reset returns [m]",
        "eval_metrics": "EvalMetrics: sums over the first episode",
        "completed_eval_metrics": "CompletedEvalMetrics: sums over ended episodes",
    }
)
"""Every key that the environments and wrappers write into ``State.info``."""

READINGS = ("state_descriptor", "xy_position")
"""Keys of ``State.info`` that read the simulation and follow it at an auto-reset."""
