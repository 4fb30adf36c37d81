"""The base classes of all environments."""

from __future__ import annotations

import abc
import functools
import inspect
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from newton_qd.checks import message
from newton_qd.envs import rollouts
from newton_qd.envs.renamed import accept_params, share_synonyms
from newton_qd.envs.shown import described
from newton_qd.envs.state import State, no_brax_view
from newton_qd.robots import Material, RobotSpec
from newton_qd.scenes import Scene
from newton_qd.types import Action, Params, RNGKey


class Env(abc.ABC):
    """An environment: two pure functions and their sizes.

    Environments are immutable. They compare and hash by identity, so they can be static
    arguments of jitted functions.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Lets ``step`` do without ``params``, as in wrappers written for QDax."""
        super().__init_subclass__(**options)
        accept_params(cls)

    def __repr__(self) -> str:
        return described(self)

    @abc.abstractmethod
    def reset(self, rng: RNGKey) -> State:
        """Begins an episode.

        Args:
            rng: One key, ``jax.random.key(0)`` or ``jax.random.PRNGKey(0)``.

        Raises:
            TypeError: ``rng`` is not a key.
            ValueError: ``rng`` is several keys, or the environment is float64 and JAX
                x64 is off.
        """

    @abc.abstractmethod
    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one control step of ``dt``.

        Args:
            state: State at the start. It does not change and can be stepped again.
            action: (nu,) array of the environment's dtype, usually from -1 to 1.
            params: Physical parameters of the world: ``default_params`` with some
                fields replaced. ``None``: the values of the robot's files.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state comes from another environment, the action has the
                wrong shape, ``params`` do not fit this robot, or the environment is
                float64 and JAX x64 is off.
        """

    def rollout(self, state: State, actions: Action, params: Params = None) -> State:
        """Runs a plan of actions.

        The states equal those of ``step`` in ``jax.lax.scan``, bit by bit, and so do
        their gradients to rounding. The physics of all steps is one call, which makes
        few worlds much faster. It needs wrappers that leave the physics alone: with
        ``auto_reset=True``, the steps run one by one.

        Args:
            state: State at the start. One of a batch has the batch axis in front.
            actions: (T, nu) actions of the environment's dtype, usually from -1 to 1.
                For a batch: (T, batch, nu).
            params: Physical parameters of the world, as for ``step``.

        Returns:
            The states after each step, leaves (T, ...); of a batch (T, batch, ...).

        Raises:
            TypeError: The state or an action has the wrong type.
            ValueError: The state comes from another environment, the actions have the
                wrong shape, ``params`` do not fit this robot, or the environment is
                float64 and JAX x64 is off.
        """
        return rollouts.rollout(self, state, actions, params)

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
        """Default ``params`` of a step; ``None`` if there are no parameters.

        In a batch, the first axis of every parameter is the batch axis.
        """
        return None

    @property
    def unwrapped(self) -> Env:
        """The environment inside all wrappers."""
        return self

    def with_base(self, change: Callable[[Env], Env]) -> Env:
        """Returns the same wrappers around another environment.

        Args:
            change: Makes the new inner environment from ``unwrapped``. This environment
                and its wrappers do not change.
        """
        return change(self)

    def with_scene(self, scene: Scene | None) -> Env:
        """Returns the same wrappers around the same robot in another scene.

        Args:
            scene: Obstacles on the ground; ``None``: no obstacles. This environment and
                its wrappers stay as they are.

        Raises:
            NotImplementedError: The environment inside is not a simulated robot.
        """
        raise NotImplementedError(not_simulated("scene", scene, self))

    def with_robot(self, robot: RobotSpec) -> Env:
        """Returns the same wrappers around the same task for another robot.

        Args:
            robot: Spec of a robot with the same joints, links, torso, feet and
                actuators, in the same order. This environment and its wrappers do not
                change.

        Raises:
            NotImplementedError: The environment inside is not a simulated robot.
        """
        raise NotImplementedError(not_simulated("robot", robot, self))

    def with_material(self, material: Material) -> Env:
        """Returns the same wrappers around the same robot with another material.

        Args:
            material: Softness of contacts and joint limits. This environment and its
                wrappers do not change.

        Raises:
            NotImplementedError: The environment inside is not a simulated robot.
        """
        raise NotImplementedError(not_simulated("material", material, self))

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Raises an error that names the wrapper for views of brax v1.

            Raises:
                AttributeError: Always. Python calls this for missing attributes only.
            """
            raise_own_error(self, name)
            raise AttributeError(no_brax_view(self, name, ("sys",)))


def raise_own_error(thing: object, name: str) -> None:
    """Raises the AttributeError inside a property, which Python hides.

    If a property raises AttributeError, Python calls ``__getattr__`` as if there were
    no property.

    Raises:
        AttributeError: The class has a property of this name, and it raises one.
    """
    own = inspect.getattr_static(type(thing), name, None)
    if not isinstance(own, property | functools.cached_property):
        return
    try:
        own.__get__(thing, type(thing))
    except AttributeError as error:
        place = f"{type(thing).__name__}.{name}"
        # without the original: its name would look like that of the property
        raise AttributeError(f"inside of the property {place}: {error}") from error


class QDEnv(Env):
    """An environment that writes ``info["state_descriptor"]``.

    The descriptor of an episode has the same length and limits as the state descriptor.
    Both names that QDax has used for them work, also for a subclass that overrides one.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        """Gives the class both names of the properties of an episode's descriptor."""
        super().__init_subclass__(**options)
        share_synonyms(cls)

    @property
    @abc.abstractmethod
    def state_descriptor_length(self) -> int:
        """Length of a state descriptor."""

    @property
    @abc.abstractmethod
    def state_descriptor_name(self) -> str:
        """Name of the quantity that a state descriptor measures."""

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


def not_simulated(name: str, value: object, env: Env) -> str:
    """Returns the error message for an environment that is not a simulated robot.

    Args:
        name: Argument that needs a simulated robot.
        value: Its value.
        env: The environment.
    """
    why = f"and {env.name} is not a simulated robot"
    allowed = "environments whose unwrapped is a PhysicsEnv"
    return message(name, value, allowed, why=why)
