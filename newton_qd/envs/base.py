"""The base class of all simulated robots."""

from __future__ import annotations

import abc
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks, physics
from newton_qd.envs import inputs
from newton_qd.envs.changes import WithChanges
from newton_qd.envs.env import Env, QDEnv
from newton_qd.envs.joints import joint_indices, joint_slices
from newton_qd.envs.options import checked_options
from newton_qd.envs.renamed import keep_old_names
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State, select
from newton_qd.physics.explicit_mesh import split_as
from newton_qd.physics.step import step_or_known
from newton_qd.physics.system import Kinematics, PhysicsState, System
from newton_qd.robots import RobotSpec
from newton_qd.scenes import Scene
from newton_qd.types import Action, Metrics, Observation, Params, RNGKey

__all__ = ["Env", "PhysicsEnv", "QDEnv"]


class PhysicsEnv(WithChanges):
    """A simulated robot; the base class for your own environments.

    A subclass overrides ``outcome``, which computes the reward of a step. It may also
    override ``observe``, ``reset_pose`` and ``control``. JAX traces these methods, and
    each works on one world: use ``jax.numpy``, and change nothing in place. ``joint``
    and ``kinematics`` help to read a state.

    A world has a fault if a value is not finite or a speed is above 1,000 m/s or rad/s.
    It then keeps its last state. ``info["fault"]`` is 1 until the next reset, reward
    and metrics are 0, done is 1, and the gradient is 0. Other worlds are not affected.

    Attributes:
        robot: Spec of the robot.
        system: The robot in the form that the physics uses.
    """

    forward_reward_name: str | None = None
    """Metric with the forward part of the reward; ``None``: no forward part."""
    rollout_order: RolloutOrder = RolloutOrder.AT_ONCE
    """How ``rollout`` runs the steps of a plan."""
    termination_width: float | None = None
    """Width of the gradient of done at the limits [m or rad]; ``None``: none."""
    reads_bodies: bool = False
    """Whether a step returns the poses of bodies too; ``kinematics`` is then faster."""

    def __init_subclass__(cls, **options: Any) -> None:
        """Keeps methods working that are overridden by their old names."""
        super().__init_subclass__(**options)
        keep_old_names(cls)

    @checked_options
    def __init__(
        self,
        robot: RobotSpec,
        *,
        reset_noise_scale: float = 0.1,
        reset_velocity_noise_scale: float | None = None,
        dtype: str = "float32",
        scene: Scene | None = None,
    ) -> None:
        """Loads the robot.

        Args:
            robot: Spec of the robot.
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            reset_velocity_noise_scale: The same for velocities; ``None``: as for
                angles.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.
            scene: Obstacles on the ground; ``None``: no obstacles.

        Raises:
            TypeError: An argument has the wrong type.
            ValueError: The robot or the scene cannot be built, the robot has no
                actuators, or ``observe`` or ``outcome`` returns a wrong shape.
                ``newton_qd.create`` checks the other methods, too.
            FileNotFoundError: A URDF file is missing.
        """
        self.robot = robot
        self._dtype = checks.precision(dtype)
        self._angle_noise = self._velocity_noise = reset_noise_scale
        if reset_velocity_noise_scale is not None:
            self._velocity_noise = reset_velocity_noise_scale
        self._feet_width: float | None = None
        self._feet_tail = "exponential"
        self._load(scene)

    def _built(self, scene: Scene | None) -> System:
        return physics.load_system(
            self.robot,
            self._dtype.name,
            scene,
            feet_width=self._feet_width,
            feet_tail=self._feet_tail,
            reports_bodies=self.reads_bodies,
        )

    def _load(self, scene: Scene | None) -> None:
        self.system = system = self._built(scene)
        self._joint_q, self._joint_v = joint_indices(system)
        inputs.require_actuators(system)
        rest = jax.eval_shape(self._rest)
        action = jax.ShapeDtypeStruct((self.action_size,), self._dtype)
        self._layout: tuple[tuple[str, int], ...] = ()
        self._metrics: tuple[str, ...] = ()
        try:
            jax.eval_shape(self._record_names, rest, action)
        except AttributeError as error:
            if error.obj is self:
                error.add_note(
                    "PhysicsEnv.__init__ calls observe and outcome: set the attributes "
                    "that they read before super().__init__(...)"
                )
            raise

    def observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the observation; by default all coordinates and velocities.

        Args:
            state: State of the world.
            action: (nu,) the action of the last step; zero after a reset.

        Returns:
            The blocks (n,) of the observation by name, such as "root height [m]". The
            observation joins them in this order, in the environment's dtype.
        """
        del action
        return {
            "coordinates [m or rad]": state.q,
            "velocities [m/s or rad/s]": state.v,
        }

    @abc.abstractmethod
    def outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns the reward of a step, whether the episode ends, and metrics.

        Args:
            before: State at the start of the step.
            after: State at its end, ``dt`` later.
            action: (nu,) the action.

        Returns:
            Reward (); done (), either a boolean or 0 and 1; metrics () by name.
        """

    def control(self, state: PhysicsState, action: Action) -> jax.Array:
        """Returns the control of the actuators in a step; by default the action.

        Args:
            state: State at the start of the step.
            action: (nu,) the action.

        Returns:
            (nu,) control. Control times gear is the torque [N m] or force [N] of an
            actuator. The control of a servo is its target [rad or m].
        """
        del state
        return action

    def reset_pose(self, rng: RNGKey, q: jax.Array) -> jax.Array:
        """Returns the first pose of an episode, before noise; by default the rest pose.

        Args:
            rng: One key.
            q: (nq,) coordinates of the default pose [m or rad].

        Returns:
            (nq,) coordinates [m or rad]. Quaternions may have any length above 0. A
            robot without ``rest_height`` is then moved up or down until its lowest
            contact is on the ground.
        """
        del rng
        return q

    def joint(self, name: str) -> tuple[slice, slice]:
        """Returns the slices of a joint in the coordinates and in the velocities.

        Args:
            name: Name of the joint in the URDF file.

        Returns:
            Its slices of ``state.q`` [m or rad] and of ``state.v`` [m/s or rad/s].

        Raises:
            ValueError: The robot has no such joint.
        """
        return joint_slices(self.system, name)

    def kinematics(self, state: PhysicsState) -> Kinematics:
        """Returns the poses and velocities of the bodies of a state.

        Row i is body ``system.body_names[i]``. ``reads_bodies = True`` makes it faster.

        Args:
            state: State of one world: ``pipeline_state`` of a ``State``.

        Raises:
            TypeError: It is not a state of the physics.
        """
        allowed = "a PhysicsState, such as state.pipeline_state"
        checks.instance("state", state, PhysicsState, allowed)
        return physics.seen_bodies(self.system, state)

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode in the default pose with noise on the joints.

        Raises:
            TypeError: ``rng`` is not a key.
            ValueError: ``rng`` is several keys, or the environment is float64 and JAX
                x64 is off.
        """
        checks.x64(self._dtype)
        inputs.require_key("rng", rng)
        root_key, angle_key, velocity_key = jax.random.split(rng, 3)
        rest = split_as([rng], self._rest())
        q = self._number(self.reset_pose(root_key, rest.q))
        q = physics.unit_quaternions(self.system, q)
        q = q.at[self._joint_q].add(self._noise(angle_key, self._angle_noise))
        q = physics.on_ground(self.system, q)
        noise = self._noise(velocity_key, self._velocity_noise)
        v = rest.v.at[self._joint_v].set(noise)
        state = self._first_state(physics.initial_state(self.system, q, v))
        return split_as([rng], state)

    def fixed_state(self) -> State:
        """Returns the state of a reset without noise: the default pose, at rest.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        checks.x64(self._dtype)
        return self._first_state(self._rest())

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one control step, or freezes a world that has a fault.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state, the action or ``params`` do not fit this robot, or
                the environment is float64 and JAX x64 is off.
        """
        checks.x64(self._dtype)
        inputs.require_robot_state(state, self.system, self._metrics)
        action = inputs.checked_action(action, self.action_size, self._dtype)
        given = (state, action, params)
        state, action, params = split_as([state.obs, action], given)
        # NaN control tells the physics to freeze a world. ``outcome`` gets finite
        # numbers instead, so that its gradient is 0 and not 0 * nan ("double where").
        # The NaN is a constant: jax.debug_nans would find an array that is computed.
        start: PhysicsState = state.pipeline_state
        sound = jnp.all(jnp.isfinite(action)) & (state.info["fault"] == 0)
        control = self._number(self.control(start, action))
        control = jnp.where(sound, control, jnp.nan)
        after, fault = step_or_known(self.system, start, control, params)
        fault = jnp.maximum(state.info["fault"], fault)
        faulty = fault != 0
        action = jnp.where(faulty, jnp.zeros_like(action), action)
        before = select(faulty, after, start)
        reward, done, metrics = jax.tree.map(
            self._number, self.outcome(before, after, action)
        )
        reward, metrics = select(
            faulty, jax.tree.map(jnp.zeros_like, (reward, metrics)), (reward, metrics)
        )
        return state.replace(
            pipeline_state=after,
            obs=self._observation(after, action),
            reward=reward,
            done=jnp.where(faulty, jnp.ones_like(done), done),
            metrics={**state.metrics, **metrics},
            info={**state.info, "fault": fault},
        )

    @property
    def default_params(self) -> physics.PhysicsParams:
        """Physical parameters of one world, with the values of the robot's files.

        Raises:
            ValueError: The environment is float64 and JAX x64 is off.
        """
        checks.x64(self._dtype)
        return physics.default_params(self.system)

    @property
    def observation_layout(self) -> tuple[tuple[str, int], ...]:
        """Name and size of each block of the observation, in order."""
        return self._layout

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return sum(size for _, size in self._layout)

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return self.system.nu

    @property
    def dtype(self) -> np.dtype:
        """Type of every floating-point array of a state, and of the actions."""
        return self._dtype

    @property
    def dt(self) -> float:
        """Duration of a step [s]."""
        return self.robot.dt

    @property
    def name(self) -> str:
        """Name of the robot."""
        return self.robot.name

    def _rest(self) -> PhysicsState:
        """Returns the default pose, at rest."""
        q = jnp.asarray(self.system.rest_q, self._dtype)
        v = jnp.zeros((self.system.nv,), self._dtype)
        return physics.initial_state(self.system, q, v)

    def _record_names(self, state: PhysicsState, action: Action) -> None:
        # stored here because eval_shape would return the blocks sorted by name
        name, blocks = type(self).__name__, self.observe(state, action)
        self._layout = inputs.checked_layout(name, blocks)
        found = self.outcome(state, state, action)
        self._metrics = inputs.checked_outcome(name, found)

    def _number(self, value: jax.Array) -> jax.Array:
        return jnp.asarray(value, self._dtype)

    def _noise(self, rng: RNGKey, scale: float) -> jax.Array:
        shape = self._joint_q.shape
        return jax.random.uniform(rng, shape, self._dtype, -scale, scale)

    def _observation(self, state: PhysicsState, action: Action) -> Observation:
        blocks = self.observe(state, action).values()
        numbers = [self._number(block) for block in blocks]
        return jnp.concatenate(split_as([state.q], numbers))

    def _first_state(self, state: PhysicsState) -> State:
        action = jnp.zeros((self.action_size,), self._dtype)
        return State(
            pipeline_state=state,
            obs=self._observation(state, action),
            reward=jnp.zeros((), self._dtype),
            done=jnp.zeros((), self._dtype),
            metrics={name: jnp.zeros((), self._dtype) for name in self._metrics},
            info={"fault": jnp.zeros((), jnp.int32)},
        )
