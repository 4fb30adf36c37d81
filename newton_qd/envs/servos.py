"""Actions that are targets of joints which hold angles or places."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.envs.vectors import rounded
from newton_qd.physics.system import System
from newton_qd.types import Action


class Servos:
    """Part of an environment whose actuators are all servos."""

    system: System

    @property
    def servo_range(self) -> tuple[np.ndarray, np.ndarray]:
        """Targets (nu,) of actions of -1, and of 1 [rad or m]: the joints' limits."""
        dofs = self.system.control_dof
        return self.system.limit_lower[dofs], self.system.limit_upper[dofs]

    def servo_targets(self, action: Action) -> jax.Array:
        """Returns targets: -1 is the lower end of a servo's range, 1 the upper end.

        Args:
            action: (nu,) the action; beyond -1 and 1 it is clipped.

        Returns:
            (nu,) targets [rad or m].
        """
        low, high = (jnp.asarray(end, self.system.dtype) for end in self.servo_range)
        return low + rounded((high - low) * (jnp.clip(action, -1, 1) + 1) / 2)
