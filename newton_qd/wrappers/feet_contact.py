"""Feet contact as the state descriptor."""

from __future__ import annotations

import copy
from typing import Self

import jax
import jax.numpy as jnp

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State
from newton_qd.extractors import get_feet_contact_proportion
from newton_qd.physics.system import TAILS, PhysicsState
from newton_qd.types import Descriptor
from newton_qd.wrappers.base import unsupported
from newton_qd.wrappers.descriptor import DescriptorWrapper


class FeetContactWrapper(DescriptorWrapper):
    """Writes which feet touched the ground into ``info["state_descriptor"]``.

    Contacts are impulses over a control step, so no foot has contact after a reset.
    If actions are repeated, the last repetition counts.
    """

    rollout_order = RolloutOrder.AT_ONCE
    descriptor_extractor = staticmethod(get_feet_contact_proportion)

    def __init__(
        self,
        env: Env,
        env_name: str,
        smooth_width: float | None = None,
        straight_through: bool = False,
        smooth_tail: str = "exponential",
    ) -> None:
        """Wraps a robot with feet.

        Args:
            env: The environment.
            env_name: Its name, used in errors.
            smooth_width: ``None``: the contact is 0 or 1 and has no gradient. A number
                above 0: the contact rises smoothly from 0 to 1 over this share of the
                robot's weight [-].
            straight_through: Whether the contact is 0 or 1, but has the gradient of
                the smooth contact.
            smooth_tail: How the slope of the smooth contact decays for large loads:
                ``"exponential"``, or ``"algebraic"``, which has a useful gradient for
                a foot that stands.

        Raises:
            NotImplementedError: The environment is not a simulated robot with feet.
            TypeError: ``env`` is not an environment, the width is not a number, or
                ``straight_through`` is not ``True`` or ``False``.
            ValueError: The width is not finite or not above 0, or is missing for a
                straight-through gradient or an algebraic tail; or the tail is not
                allowed.
        """
        checks.environment(env, needs="unwrapped")
        robot = env.unwrapped
        if not isinstance(robot, PhysicsEnv) or not len(robot.system.feet):
            allowed = "simulated robots with feet"
            if isinstance(robot, PhysicsEnv):
                allowed += ", so set RobotSpec.feet"
            raise NotImplementedError(unsupported(env, env_name, allowed))
        checks.number("smooth_width", smooth_width, above=0, optional=True)
        checks.choice("smooth_tail", smooth_tail, TAILS)
        checks.flag("straight_through", straight_through)
        if straight_through and smooth_width is None:
            allowed = (
                "a width above 0 with straight_through=True, over which the gradient "
                "is smooth"
            )
            raise ValueError(message("smooth_width", None, allowed))
        if smooth_tail != "exponential" and smooth_width is None:
            allowed = "'exponential', or a smooth_width above 0 too"
            raise ValueError(message("smooth_tail", smooth_tail, allowed))
        if smooth_width is not None:
            env = env.with_base(
                lambda base: _with_smooth_feet(base, smooth_width, smooth_tail)
            )
        super().__init__(env, env_name)
        self._smooth = smooth_width is not None
        self._straight_through = straight_through

    def smoothed(self, width: float, straight_through: bool, tail: str) -> Self:
        """Returns this wrapper with a smooth contact; this one does not change.

        Args:
            width: As ``smooth_width`` of the class; it is checked already.
            straight_through: As for the class.
            tail: As ``smooth_tail`` of the class.
        """
        changed = copy.copy(self)
        changed.env = self.env.with_base(
            lambda base: _with_smooth_feet(base, width, tail)
        )
        changed._smooth, changed._straight_through = True, straight_through
        return changed

    def describe(self, state: State) -> Descriptor:
        """Returns the ground contact of each foot (nf,), from 0 to 1."""
        physics: PhysicsState = state.pipeline_state
        if not self._smooth:
            return physics.feet_contact
        smooth = physics.smooth_feet_contact
        if not self._straight_through:
            return smooth
        # Bengio et al. 2013, "Estimating or propagating gradients through stochastic
        # neurons"; the value of the added difference is exactly 0
        return physics.feet_contact + (smooth - jax.lax.stop_gradient(smooth))

    @property
    def _robot(self) -> PhysicsEnv:
        base = self.unwrapped
        assert isinstance(base, PhysicsEnv)
        return base

    @property
    def state_descriptor_length(self) -> int:
        """Number of feet."""
        return len(self._robot.system.feet)

    @property
    def state_descriptor_name(self) -> str:
        """Name of the quantity that a state descriptor measures."""
        return "feet_contact"

    @property
    def state_descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        """Lower and upper limits, (nf,) each."""
        size = (self.state_descriptor_length,)
        return jnp.zeros(size, self.dtype), jnp.ones(size, self.dtype)


def _with_smooth_feet(env: Env, width: float, tail: str) -> Env:
    assert isinstance(env, PhysicsEnv)
    return env.with_feet_width(width, tail)
