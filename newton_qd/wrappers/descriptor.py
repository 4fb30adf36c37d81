"""The base class of wrappers that write a state descriptor."""

from __future__ import annotations

import abc
from collections.abc import Sequence
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env, QDEnv
from newton_qd.envs.inputs import OWN_STATE, require_state
from newton_qd.envs.rollouts import RolloutOrder
from newton_qd.envs.state import State
from newton_qd.extractors import get_mean_state_descriptor
from newton_qd.real_numbers import real_numbers, require_real
from newton_qd.types import Action, Descriptor, DescriptorExtractor, Params, RNGKey
from newton_qd.wrappers.base import Wrapper, outermost


class DescriptorWrapper(Wrapper, QDEnv):
    """Writes ``info["state_descriptor"]``; the base class for your own descriptors.

    A subclass overrides ``describe`` and ``limits``. It may also override
    ``descriptor_extractor``. ``rollout`` calls ``describe`` for one step after the
    other. If ``describe`` does not read what earlier steps have written into ``info``,
    the subclass may set ``rollout_order = RolloutOrder.AT_ONCE``, which is faster.
    """

    rollout_order = RolloutOrder.AT_ONCE
    limits: ClassVar[tuple[Sequence[float], Sequence[float]]]
    """Lowest and highest value of each of the nd components. Values beyond these limits
    are in the outermost cells of an archive."""
    descriptor_labels: ClassVar[Sequence[str]] = ()
    """Names of the nd components, with their units, for pictures and pages."""
    descriptor_extractor: DescriptorExtractor = staticmethod(get_mean_state_descriptor)
    """Computes descriptors of episodes from state descriptors; by default the mean."""

    def __init__(self, env: Env, env_name: str) -> None:
        """Wraps an environment.

        Args:
            env: The environment.
            env_name: Its name, used in errors.

        Raises:
            ValueError: The class has no ``limits``, or they are not of one length with
                the lowest value of each component below the highest.
        """
        # limits of a class that makes them itself are not asked for
        own = type(self).state_descriptor_limits
        if own is DescriptorWrapper.state_descriptor_limits:
            _check_limits(type(self))
        super().__init__(env)

    @abc.abstractmethod
    def describe(self, state: State) -> Descriptor:
        """Returns the state descriptor of a state.

        Args:
            state: State of one world after a reset or a step; ``pipeline_state`` is the
                ``PhysicsState`` of a simulated robot.

        Returns:
            (nd,) state descriptor.
        """

    def reset(self, rng: RNGKey) -> State:
        """Begins an episode.

        Raises:
            TypeError: ``describe`` does not return real numbers.
            ValueError: ``describe`` returns another shape than the limits have, a
                wrapper inside writes a state descriptor of another length, or the
                environment is float64 and JAX x64 is off.
        """
        self._refuse_another_length()
        return self._described(self.env.reset(rng))

    def step(self, state: State, action: Action, params: Params = None) -> State:
        """Advances by one step.

        Raises:
            TypeError: The state or the action has the wrong type.
            ValueError: The state or the action is of another environment.
        """
        require_state(state, "state_descriptor")
        size = (self.state_descriptor_length,)
        found = jnp.shape(state.info["state_descriptor"])
        if found[-1:] != size:
            given = Fact(f"a state descriptor of shape {found}")
            allowed = f"{OWN_STATE}, so a state descriptor of shape {size}"
            raise ValueError(message("state", given, allowed))
        return self._described(self.env.step(state, action, params))

    def _refuse_another_length(self) -> None:
        """Checks that this wrapper's state descriptor fits the wrappers inside.

        The wrapper inside would refuse the next step, as one of another environment.

        Raises:
            ValueError: A wrapper inside writes one of another length.
        """
        inside = outermost(self.env, DescriptorWrapper)
        if inside is None:
            return
        theirs, own = inside.state_descriptor_length, self.state_descriptor_length
        if theirs != own:
            given = Fact(
                f"an environment with {type(inside).__name__}, of length {theirs}"
            )
            allowed = f"one without descriptor, or with one of length {own}"
            why = f"and {type(self).__name__} would write another one in its place"
            raise ValueError(message("env", given, allowed, why=why))

    def _described(self, state: State) -> State:
        describe = self._checked
        for _ in range(jnp.ndim(state.done)):
            describe = jax.vmap(describe)
        # JAX could not donate a state that has a buffer twice
        described = jnp.copy(describe(state))
        return state.replace(info={**state.info, "state_descriptor": described})

    def _checked(self, state: State) -> Descriptor:
        """Returns the state descriptor of one world.

        Raises:
            TypeError: It does not have real numbers.
            ValueError: It is of another shape than the limits have.
        """
        found = self.describe(state)
        for part in found if isinstance(found, list | tuple) else [found]:
            require_real(f"{type(self).__name__}.describe", part)
        described = jnp.asarray(found, self.dtype)
        if described.shape != (self.state_descriptor_length,):
            allowed = f"shape {(self.state_descriptor_length,)}, as its limits"
            raise ValueError(
                message(f"{type(self).__name__}.describe", described, allowed)
            )
        return described

    @property
    def state_descriptor_length(self) -> int:
        """Length of a state descriptor."""
        return len(self.limits[0])

    @property
    def state_descriptor_name(self) -> str:
        """Name of the quantity that a state descriptor measures: the class name."""
        return type(self).__name__

    @property
    def state_descriptor_limits(self) -> tuple[jax.Array, jax.Array]:
        """Lower and upper limits, (nd,) each."""
        low, high = self.limits
        return jnp.asarray(low, self.dtype), jnp.asarray(high, self.dtype)


def _check_limits(kind: type[DescriptorWrapper]) -> None:
    """Checks the limits of a class, and its labels.

    Raises:
        ValueError: The limits are missing, or not two rows of numbers, lowest first. Or
            there are labels, and their number is another one.
    """
    limits = getattr(kind, "limits", None)
    pair = real_numbers(limits)
    if (
        pair is None
        or pair.ndim != 2
        or len(pair) != 2
        or not np.all(pair[0] < pair[1])
    ):
        allowed = "lowest and highest values, such as ((0.0, 0.0), (1.0, 1.0))"
        raise ValueError(message(f"{kind.__name__}.limits", limits, allowed))
    labels, length = kind.descriptor_labels, len(pair[0])
    names = [isinstance(label, str) for label in labels]
    if names and (isinstance(labels, str) or not all(names) or len(names) != length):
        name = f"{kind.__name__}.descriptor_labels"
        raise ValueError(message(name, labels, f"{length} names, as the limits have"))
