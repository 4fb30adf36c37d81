"""Humanoid: run along x on two legs."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import physics
from newton_qd.envs.base import PhysicsEnv
from newton_qd.envs.contacts import isotropic_inertia
from newton_qd.envs.limits import survival, within
from newton_qd.envs.options import checked_options
from newton_qd.envs.vectors import cross, length, ordered_sum, rounded
from newton_qd.physics.system import Kinematics, PhysicsState
from newton_qd.robots import HUMANOID, RobotSpec
from newton_qd.scenes import Scene
from newton_qd.types import Action, Metrics

_ROOT_V = 6  # a free root has 6 velocities
_NEAR = 1e-7  # avoids a division by 0 at the centre of mass [m^2]
# Order of the observed joints: with one axis, then with two, then with three.
_OBSERVED = (
    *("abdomen_x", "right_knee", "left_knee", "right_elbow", "left_elbow"),
    *("abdomen_z", "abdomen_y"),
    *(f"{side}_shoulder{axis}" for side in ("right", "left") for axis in "12"),
    *(f"{side}_hip_{axis}" for side in ("right", "left") for axis in "xyz"),
)


class Humanoid(PhysicsEnv):
    """A trunk with arms on two legs, rewarded for velocity along x.

    Reward: velocity of the centre of mass along x, plus a bonus for being healthy,
    minus a cost of control. Done when unhealthy. Only the shins touch the ground. Other
    bodies pass through it, as in the original.

    Metrics:
        forward_reward: Velocity of the centre of mass along x times its weight.
        reward_linvel: The same.
        reward_quadctrl: Minus the cost of control [-].
        reward_alive: Bonus for being healthy [-].
        x_position: x of the robot's centre of mass [m].
        y_position: Its y [m].
        distance_from_origin: Its distance from the origin, in 3D [m].
        x_velocity: Its velocity along x [m/s].
        y_velocity: Its velocity along y [m/s].
    """

    forward_reward_name: str | None = "reward_linvel"
    reads_bodies = True
    _spec: RobotSpec = HUMANOID
    _scene: Scene | None = None

    @checked_options
    def __init__(
        self,
        *,
        forward_reward_weight: float = 1.25,
        ctrl_cost_weight: float = 0.1,
        healthy_reward: float = 5.0,
        terminate_when_unhealthy: bool = True,
        healthy_z_range: tuple[float, float] = (0.8, 2.1),
        reset_noise_scale: float = 1e-2,
        exclude_current_positions_from_observation: bool = True,
        dtype: str = "float32",
    ) -> None:
        """Loads the humanoid.

        Args:
            forward_reward_weight: Reward of a velocity along x [s/m].
            ctrl_cost_weight: Cost of the sum of squared actions [-].
            healthy_reward: Bonus per step [-].
            terminate_when_unhealthy: Whether an unhealthy torso ends the episode;
                if not, it only loses the bonus.
            healthy_z_range: Lowest and highest healthy height of the torso [m].
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            exclude_current_positions_from_observation: Whether the observation
                omits x and y of the torso.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.

        Raises:
            TypeError: An option has the wrong type.
            ValueError: An option has a value that is not allowed.
        """
        self._forward_reward_weight = forward_reward_weight
        self._ctrl_cost_weight = ctrl_cost_weight
        self._healthy_reward = healthy_reward
        self._terminate_when_unhealthy = terminate_when_unhealthy
        self._healthy_z_range = healthy_z_range
        self._omit_xy = exclude_current_positions_from_observation
        super().__init__(
            self._spec,
            reset_noise_scale=reset_noise_scale,
            dtype=dtype,
            scene=self._scene,
        )

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the blocks of the observation."""
        q, v, system = state.q, state.v, self.system
        joints = np.array([system.joint_names.index(name) for name in _OBSERVED])
        dofs = system.v_start[joints]
        driven = [system.control_dof.tolist().index(dof) for dof in dofs]
        torque = action * np.asarray(system.gear, system.dtype)
        blocks = {} if self._omit_xy else {"torso position x y [m]": q[:2]}
        return blocks | {
            "torso height [m]": q[2:3],
            "torso orientation w x y z": jnp.concatenate([q[6:7], q[3:6]]),
            "joint angles [rad]": q[system.q_start[joints]],
            "torso velocity x y z [m/s]": v[:3],
            "torso angular velocity x y z [rad/s]": v[3:_ROOT_V],
            "joint velocities [rad/s]": v[dofs],
            **self._observe_bodies(state),
            "actuator torques [N m]": torque[np.array(driven)],
        }

    def _observe_bodies(self, state: PhysicsState) -> dict[str, jax.Array]:
        """Returns inertia and velocities of each body about the centre of mass."""
        bodies = self._bodies
        seen = physics.seen_bodies(self.system, state)
        mass = jnp.asarray(self.system.mass[bodies], self.dtype)[:, None]
        velocity = seen.linear_velocity[bodies]
        arm = seen.com[bodies] - self._centre_of_mass(seen)[None]
        square = ordered_sum(jnp.square(arm).T)[:, None]
        share = mass * velocity / np.asarray(self.system.total_mass, self.dtype)
        turning = cross(arm, velocity) / (_NEAR + square)
        return {
            "body inertias about the centre of mass [kg m^2]": (
                self._inertia_about_centre(mass, arm, square).reshape(-1)
            ),
            "body velocities by share of mass [m/s]": share.reshape(-1),
            "body velocities about the centre of mass [rad/s]": turning.reshape(-1),
        }

    def _inertia_about_centre(
        self, mass: jax.Array, arm: jax.Array, square: jax.Array
    ) -> jax.Array:
        """Returns the inertias of the bodies about the robot's centre of mass.

        Args:
            mass: (n, 1) [kg].
            arm: (n, 3) body relative to the centre of mass [m].
            square: (n, 1) squared length of ``arm`` [m^2].

        Returns:
            (n, 3, 3) [kg m^2]. The outer product of the arms is not multiplied by the
            mass, as in the original.
        """
        products = arm[:, :, None] * arm[:, None, :]
        return self._rotational(mass * square) - rounded(products)

    def _rotational(self, added: jax.Array) -> jax.Array:
        """Returns the bodies' inertia plus ``added`` (n, 1), as (n, 3, 3) [kg m^2]."""
        moment = isotropic_inertia(self.system, self._bodies, "observed inertias")
        own = jnp.asarray(moment, self.dtype)[:, None]
        total = own + rounded(added)
        return total[:, :, None] * jnp.eye(3, dtype=self.dtype)[None]

    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward, done and metrics of a step."""
        start, position = (
            self._centre_of_mass(physics.seen_bodies(self.system, state))
            for state in (before, after)
        )
        velocity = (position[:2] - start[:2]) / self.dt
        healthy = within(after.q[2], self._healthy_z_range, self.termination_width)
        ends = self._terminate_when_unhealthy
        bonus, done = survival(healthy, self._healthy_reward, ends=ends)
        forward = rounded(self._forward_reward_weight * velocity[0])
        control = rounded(self._ctrl_cost_weight * ordered_sum(jnp.square(action)))
        metrics = {
            "forward_reward": forward,
            "reward_linvel": forward,
            "reward_quadctrl": -control,
            "reward_alive": bonus,
            "x_position": position[0],
            "y_position": position[1],
            "distance_from_origin": length(position),
            "x_velocity": velocity[0],
            "y_velocity": velocity[1],
        }
        return forward + bonus - control, done, metrics

    def _centre_of_mass(self, seen: Kinematics) -> jax.Array:
        """Returns the robot's centre of mass (3,) [m]."""
        share = self.system.mass[self._bodies] / self.system.total_mass
        weights = jnp.asarray(share, self.dtype)[:, None]
        return ordered_sum(weights * seen.com[self._bodies])

    @property
    def _bodies(self) -> np.ndarray:
        """Bodies with mass (n,), without the links inside joints with several axes."""
        return np.flatnonzero(self.system.mass > 0).astype(np.int32)
