"""Environments for brax: for its training code, and for all that stands on its ``Env``.

This is for the brax of today. For code that was written for brax v1, see
``newton_qd.compat``.
"""

from __future__ import annotations

import dataclasses
import functools
import types
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks, registry
from newton_qd.adapters.worlds import one_world
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.methods import random_key
from newton_qd.envs.state import State
from newton_qd.errors import MissingExtra
from newton_qd.types import Action, Params, RNGKey

try:
    from brax import envs
except ModuleNotFoundError as error:
    raise MissingExtra("brax", "brax") from error

BACKEND = "newton_qd"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, eq=False)
class BraxSystem:
    """What code for brax reads of ``env.sys``: sizes and limits.

    It is a pytree whose leaves are the physical parameters, so brax's
    ``DomainRandomizationVmapWrapper`` can give each world its own.

    Attributes:
        params: Physical parameters; ``None`` if the environment has none.
        env: The environment.
    """

    params: Params
    env: Env = dataclasses.field(metadata={"static": True})

    @property
    def actuator(self) -> types.SimpleNamespace:
        """The actuators, with ``ctrl_range`` (nu, 2): lowest and highest action."""
        rows = np.tile(np.array([-1.0, 1.0], self.env.dtype), (self.act_size(), 1))
        return types.SimpleNamespace(ctrl_range=rows)

    @property
    def opt(self) -> types.SimpleNamespace:
        """Options, with ``timestep`` [s], the duration of a control step."""
        return types.SimpleNamespace(timestep=self.env.dt)

    @property
    def link_names(self) -> tuple[str, ...]:
        """Names of the bodies."""
        base = self.env.unwrapped
        return base.system.body_names if isinstance(base, PhysicsEnv) else ()

    def act_size(self) -> int:
        """Returns the length of an action."""
        return self.env.action_size

    def q_size(self) -> int:
        """Returns the number of coordinates."""
        base = self.env.unwrapped
        return base.system.nq if isinstance(base, PhysicsEnv) else 0

    def qd_size(self) -> int:
        """Returns the number of velocities."""
        base = self.env.unwrapped
        return base.system.nv if isinstance(base, PhysicsEnv) else 0

    def num_links(self) -> int:
        """Returns the number of bodies."""
        return len(self.link_names)

    def replace(self, **changes: Any) -> BraxSystem:
        """Returns a copy with other parameters."""
        return dataclasses.replace(self, **changes)

    def tree_replace(self, changes: Mapping[str, Any]) -> BraxSystem:
        """Returns a copy with other values of some parameters, as brax's systems do.

        Args:
            changes: Values by name, such as ``{"params.friction": friction}``.

        Raises:
            ValueError: A name is not that of a parameter.
        """
        own = () if self.params is None else dataclasses.fields(self.params)
        known = {f"params.{field.name}": field.name for field in own}
        for name in changes:
            if name not in known:
                raise ValueError(message("changes", name, checks.listed(known)))
        new = {known[name]: value for name, value in changes.items()}
        params = None if self.params is None else self.params.replace(**new)
        return self.replace(params=params)


class BraxEnv(envs.Env):
    """One world as an environment of brax; brax's wrappers make batches and episodes.

    Observations, rewards and ends are bitwise those of ``env.step``. A state is a
    ``brax.envs.State``. Its ``pipeline_state`` is that of this library, with ``q`` and
    ``v``. Its ``info`` has what the wrappers of this library write, such as
    ``state_descriptor``.

    brax has no worlds that stay frozen: a step that has a fault is done, and
    ``info["fault"]`` is 1. The next step begins at the last valid state, or at the
    first one if brax resets the world.

    Attributes:
        env: The environment inside.
        sys: Its sizes and physical parameters.
    """

    def __init__(
        self, env: str | Env, *, backend: str | None = None, **options: Any
    ) -> None:
        """Builds the environment.

        Args:
            env: Name of an environment, or one of one world without auto-reset and
                without an episode length.
            backend: ``"newton_qd"`` or ``None``.
            **options: Arguments of ``newton_qd.create``, such as ``dtype``.

        Raises:
            TypeError: An argument has the wrong type, or is unknown.
            ValueError: A value is not allowed, or the environment has a batch,
                auto-reset or an episode length.
            UnknownEnvironment: The name is not registered.
        """
        if backend not in (None, BACKEND):
            why = "a physics of brax"
            raise ValueError(message("backend", backend, f"None, {BACKEND}", why=why))
        if isinstance(env, str):
            if options.get("eval_metrics"):
                why = "which needs an episode length, and brax's wrappers count steps"
                raise ValueError(message("eval_metrics", True, "False", why=why))
            if options.get("brax_views"):
                why = "the bodies of brax v1, which a state of brax has no place for"
                raise ValueError(message("brax_views", True, "False", why=why))
            options = {"episode_length": None, **options}
        self.env = one_world(env, options, endless=True)
        self.sys = self._own = BraxSystem(self.env.default_params, self.env)
        self._keys = tuple(jax.eval_shape(self.env.reset, random_key()).info)

    def reset(self, rng: RNGKey) -> envs.State:
        """Begins an episode.

        Args:
            rng: One key.
        """
        return self._shown(self.env.reset(rng), {})

    def step(self, state: envs.State, action: Action) -> envs.State:
        """Advances by one control step.

        Args:
            state: A state of this environment, as brax's wrappers changed it.
            action: (nu,) action.

        Raises:
            TypeError: ``state`` is not a state, or the action has the wrong type.
            ValueError: The state is of another environment, or the action has the
                wrong shape.
        """
        allowed = "a state, as reset() returns it"
        checks.instance("state", state, (envs.State, State), allowed)
        for key in self._keys:
            if key not in state.info:
                given = Fact(f"info without {key!r}")
                raise ValueError(message("state", given, "a state of this environment"))
        info: dict[str, Any] = {key: state.info[key] for key in self._keys}
        if "fault" in info:
            info["fault"] = jnp.zeros(jnp.shape(state.done), jnp.int32)
        given: Any = state
        inside = State(
            pipeline_state=given.pipeline_state,
            obs=given.obs,
            reward=given.reward,
            done=given.done,
            metrics=given.metrics,
            info=info,
        )
        params = None if self.sys is self._own else self.sys.params
        return self._shown(self.env.step(inside, action, params), state.info)

    @property
    def observation_size(self) -> int:
        """Length of an observation."""
        return self.env.observation_size

    @property
    def action_size(self) -> int:
        """Length of an action."""
        return self.env.action_size

    @property
    def backend(self) -> str:
        """Name of the physics."""
        return BACKEND

    @property
    def dt(self) -> float:
        """Duration of a step [s]."""
        return self.env.dt

    def _shown(self, state: State, info: dict[str, Any]) -> envs.State:
        """Returns a state as brax's, with what brax's wrappers wrote into ``info``."""
        own = dict(state.info)
        if "fault" in own:
            # floating-point as all of brax's: others differentiate with respect to it
            own["fault"] = own["fault"].astype(self.env.dtype)
        return envs.State(
            pipeline_state=state.pipeline_state,
            obs=state.obs,
            reward=state.reward,
            done=state.done,
            metrics=dict(state.metrics),
            info={**info, **own},
        )


def register_with_brax(prefix: str = "newton_qd/") -> tuple[str, ...]:
    """Adds every environment to the names of ``brax.envs.create``.

    Args:
        prefix: In front of each name. An empty one replaces brax's own ``ant`` and
            others.

    Returns:
        The names, such as ``newton_qd/ant_uni``.

    Raises:
        TypeError: ``prefix`` is not text.
    """
    checks.instance("prefix", prefix, str, "text, which may be empty")
    names = []
    for name in registry.registered_envs():
        kind: Any = functools.partial(BraxEnv, name)
        envs.register_environment(f"{prefix}{name}", kind)
        names.append(f"{prefix}{name}")
    return tuple(names)
