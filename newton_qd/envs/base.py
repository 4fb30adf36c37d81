"""What an environment is, and the part that all simulated robots share."""

from __future__ import annotations

import abc
import copy
import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import physics
from newton_qd.envs import inputs
from newton_qd.envs.joints import joint_indices
from newton_qd.envs.options import float_type
from newton_qd.envs.state import State, no_brax_view, select
from newton_qd.physics.system import PhysicsState, System
from newton_qd.robots import Material, RobotSpec
from newton_qd.scenes import Scene
from newton_qd.types import Action, Metrics, Observation, Params, RNGKey


class Env(abc.ABC):
    """An environment: two pure functions and their sizes.

    Environments are immutable, compare and hash by identity, and may be static
    arguments of jitted functions.
    """

    @abc.abstractmethod
    def reset(self, rng: RNGKey) -> State:
        """Begins an episode.

        Args:
            rng: One key, ``jax.random.key(0)`` or ``jax.random.PRNGKey(0)``.
        """

    @abc.abstractmethod
    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one control step of ``dt``.

        Args:
            state: Where to start; it is not changed and may be stepped again.
            action: (nu,) array of the environment's dtype, meant for -1 to 1.
            params: Physical parameters of the world, as ``default_params`` with fields
                replaced; ``None``: as in its files.
        """

    @property
    @abc.abstractmethod
    def observation_size(self) -> int:
        """Length of an observation."""

    @property
    @abc.abstractmethod
    def action_size(self) -> int:
        """Length of an action."""

    @property
    @abc.abstractmethod
    def dtype(self) -> np.dtype:
        """Type of every floating-point array of a state, and of the actions."""

    @property
    @abc.abstractmethod
    def dt(self) -> float:
        """Duration of a step [s]."""

    @property
    @abc.abstractmethod
    def name(self) -> str:
        """Name of the robot or of the task."""

    @property
    def default_params(self) -> Params:
        """What a step takes for ``params``: as in the files, ``None`` without any.

        In a batch every parameter has the batch axis in front.
        """
        return None

    @property
    def unwrapped(self) -> Env:
        """The environment inside all wrappers."""
        return self

    def with_base(self, change: Callable[[Env], Env]) -> Env:
        """Returns the same wrappers around another environment.

        Args:
            change: Makes the new inside from ``unwrapped``; this environment and its
                wrappers stay as they are.
        """
        return change(self)

    def with_scene(self, scene: Scene | None) -> Env:
        """Returns the same wrappers around the same robot in another scene.

        Args:
            scene: What stands on the ground; ``None``: nothing. This environment and
                its wrappers stay as they are.

        Raises:
            NotImplementedError: The environment inside is not a simulated robot.
        """
        raise NotImplementedError(
            f"scene={scene!r}: {self.name} is not a simulated robot; allowed: "
            "environments whose unwrapped is a PhysicsEnv"
        )

    def with_material(self, material: Material) -> Env:
        """Returns the same wrappers around the same robot with other softness.

        Args:
            material: Softness of contacts and joint limits. This environment and its
                wrappers stay as they are.

        Raises:
            NotImplementedError: The environment inside is not a simulated robot.
        """
        raise NotImplementedError(
            f"material={material!r}: {self.name} is not a simulated robot; allowed: "
            "environments whose unwrapped is a PhysicsEnv"
        )

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Says where views of brax v1 are."""
            raise AttributeError(no_brax_view(self, name, ("sys",)))


class QDEnv(Env):
    """An environment that writes ``info["state_descriptor"]``.

    The descriptor of an episode has the length and limits of the state descriptor,
    under both names that QDax has used for them.
    """

    @property
    @abc.abstractmethod
    def state_descriptor_length(self) -> int:
        """Length of a state descriptor."""

    @property
    @abc.abstractmethod
    def state_descriptor_name(self) -> str:
        """What a state descriptor measures."""

    @property
    @abc.abstractmethod
    def state_descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        """Lower and upper limits, (nd,) each."""

    @property
    def descriptor_length(self) -> int:
        """Length of an episode's descriptor."""
        return self.state_descriptor_length

    @property
    def descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        """Lower and upper limits of an episode's descriptor, (nd,) each."""
        return self.state_descriptor_limits

    behavior_descriptor_length = descriptor_length
    behavior_descriptor_limits = descriptor_limits


class PhysicsEnv(Env):
    """A simulated robot: reset noise, checks of the input, containment of faults.

    A subclass gives the observation and the outcome of a step. A world that meets a
    value that is not finite, or a speed beyond 1,000 m/s or rad/s, is frozen where it
    was: ``info["fault"]`` becomes 1 and stays until a reset, reward and metrics are 0,
    done is 1, and no gradient passes. Other worlds do not notice.
    """

    forward_reward_name: str | None = None
    """Metric that is the forward part of the reward; ``None``: there is none."""
    reads_bodies: bool = False
    """Whether a step is to report where the bodies are, for ``seen_bodies``."""

    def __init__(
        self,
        robot: RobotSpec,
        *,
        reset_noise_scale: float,
        reset_velocity_noise_scale: float | None = None,
        dtype: str = "float32",
        scene: Scene | None = None,
    ) -> None:
        """Loads the robot.

        Args:
            robot: Spec of the robot.
            reset_noise_scale: Half width of the uniform noise on joint angles [rad]
                and joint velocities [rad/s] at a reset.
            reset_velocity_noise_scale: That of the velocities, where it differs.
            dtype: ``"float32"``, or ``"float64"`` with JAX x64 on.
            scene: What stands on the ground; ``None``: nothing.
        """
        self.robot = robot
        self._dtype = float_type(dtype)
        self._angle_noise = self._velocity_noise = reset_noise_scale
        if reset_velocity_noise_scale is not None:
            self._velocity_noise = reset_velocity_noise_scale
        self._feet_width: float | None = None
        self._load(scene)

    def _load(self, scene: Scene | None) -> None:
        system = physics.load_system(
            self.robot,
            self._dtype.name,
            scene,
            feet_width=self._feet_width,
            reports_bodies=self.reads_bodies,
        )
        self.system: System = system
        self._joint_q, self._joint_v = joint_indices(system)
        inputs.require_actuators(system)
        self._grounding = physics.grounding_coordinate(system)
        rest = jax.eval_shape(self._rest)
        action = jax.ShapeDtypeStruct((self.action_size,), self._dtype)
        self._layout: tuple[tuple[str, int], ...] = ()
        jax.eval_shape(self._record_layout, rest, action)
        self._metrics = tuple(jax.eval_shape(self._outcome, rest, rest, action)[2])

    def with_scene(self, scene: Scene | None) -> PhysicsEnv:
        """Returns the same environment in another scene; this one stays as it is.

        Args:
            scene: What stands on the ground; ``None``: nothing.
        """
        moved = copy.copy(self)
        moved._load(scene)
        return moved

    def with_material(self, material: Material) -> PhysicsEnv:
        """Returns the same environment with other softness; this one stays as it is.

        Args:
            material: Softness of contacts and joint limits.
        """
        changed = copy.copy(self)
        changed.robot = dataclasses.replace(self.robot, material=material)
        changed._load(self.system.scene)
        return changed

    def with_feet_width(self, width: float) -> PhysicsEnv:
        """Returns the same environment with another smooth contact of the feet.

        Args:
            width: Share of the robot's weight over which it rises [-], above 0.
        """
        changed = copy.copy(self)
        changed._feet_width = width
        changed._load(self.system.scene)
        return changed

    @abc.abstractmethod
    def _observe(self, state: PhysicsState, action: Action) -> dict[str, jax.Array]:
        """Returns the named blocks (n,) of the observation, in order.

        The action is the one that led to the state; zero after a reset.
        """

    @abc.abstractmethod
    def _outcome(
        self, before: PhysicsState, after: PhysicsState, action: Action
    ) -> tuple[jax.Array, jax.Array, Metrics]:
        """Returns reward (), done () and metrics () of a step."""

    def _control(self, state: PhysicsState, action: Action) -> jax.Array:
        """Returns what drives the actuators (nu,) in a step: the action."""
        del state
        return action

    def _place(self, rng: RNGKey, q: jax.Array) -> jax.Array:
        """Returns the coordinates (nq,) of a reset with random roots: none here."""
        del rng
        return q

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode in the default pose with noise on the joints."""
        inputs.require_precision(self._dtype)
        root_key, angle_key, velocity_key = jax.random.split(rng, 3)
        rest = self._rest()
        q = self._place(root_key, rest.q)
        q = q.at[self._joint_q].add(self._noise(angle_key, self._angle_noise))
        if self._grounding is not None:
            coordinate, sign = self._grounding
            q = q.at[coordinate].add(-sign * physics.lowest_contact(self.system, q))
        noise = self._noise(velocity_key, self._velocity_noise)
        v = rest.v.at[self._joint_v].set(noise)
        return self._first_state(physics.initial_state(self.system, q, v))

    def fixed_state(self) -> State:
        """Returns the state of a reset without noise: the default pose, at rest."""
        inputs.require_precision(self._dtype)
        return self._first_state(self._rest())

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one control step, or freezes a world at fault."""
        inputs.require_precision(self._dtype)
        inputs.require_state(state, "fault")
        action = inputs.checked_action(action, self.action_size, self._dtype)
        # The physics freezes a world at fault and passes no gradient through it; a
        # world that was at fault before is handed over as one. The outcome sees numbers
        # instead, so that its zero gradient is not 0 * nan (double where).
        start: PhysicsState = state.pipeline_state
        sound = jnp.all(jnp.isfinite(action)) & (state.info["fault"] == 0)
        control = self._control(start, action)
        control = jnp.where(sound, control, jnp.full_like(control, jnp.nan))
        after, fault = physics.step(self.system, start, control, params)
        fault = jnp.maximum(state.info["fault"], fault)
        faulty = fault != 0
        action = jnp.where(faulty, jnp.zeros_like(action), action)
        before = select(faulty, after, start)
        reward, done, metrics = self._outcome(before, after, action)
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
        """Physical parameters of one world as in the robot's files."""
        inputs.require_precision(self._dtype)
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

    def _record_layout(self, state: PhysicsState, action: Action) -> None:
        # not a result of eval_shape: it would sort the names
        blocks = self._observe(state, action).items()
        self._layout = tuple((name, block.shape[0]) for name, block in blocks)

    def _noise(self, rng: RNGKey, scale: float) -> jax.Array:
        shape = self._joint_q.shape
        return jax.random.uniform(rng, shape, self._dtype, -scale, scale)

    def _observation(self, state: PhysicsState, action: Action) -> Observation:
        return jnp.concatenate(list(self._observe(state, action).values()))

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
