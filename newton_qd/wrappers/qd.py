"""The base class of wrappers around an environment with a descriptor."""

from __future__ import annotations

from typing import Any

import jax

from newton_qd.envs.base import QDEnv
from newton_qd.wrappers.base import Wrapper


class QDWrapper(Wrapper, QDEnv):
    """A wrapper around an environment with a descriptor. It forwards everything."""

    @property
    def state_descriptor_length(self) -> int:
        """Length of a state descriptor."""
        return self._described.state_descriptor_length

    @property
    def state_descriptor_name(self) -> str:
        """What a state descriptor measures."""
        return self._described.state_descriptor_name

    @property
    def state_descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        """Lower and upper limits, (nd,) each."""
        return self._described.state_descriptor_limits

    @property
    def descriptor_length(self) -> int:
        """Length of an episode's descriptor."""
        return self._described.descriptor_length

    @property
    def descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        """Lower and upper limits of an episode's descriptor, (nd,) each."""
        return self._described.descriptor_limits

    @property
    def _described(self) -> Any:
        # any environment with these properties; a wrapper may forward them
        return self.env
