"""Records trajectories: runs a policy or a plan of actions, and keeps what is seen."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks, memory, physics
from newton_qd.checks import Fact, message
from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.inputs import require_key
from newton_qd.envs.shown import component_names
from newton_qd.envs.state import State
from newton_qd.types import Action, Observation, Params, PyTree, RNGKey
from newton_qd.viewing.drawing import Drawing, drawing_of
from newton_qd.viewing.trajectory import Contacts, Trajectory

_STEPS = 1000  # of an environment without an episode length


def record(
    env: Env,
    policy: Callable[[Observation], Action] | jax.Array | np.ndarray,
    key: RNGKey | State,
    *,
    steps: int | None = None,
    worlds: int | None = None,
    params: Params = None,
    contacts: bool = False,
    labels: Sequence[str] | None = None,
) -> Trajectory:
    """Runs episodes and returns their trajectory.

    An episode of the trajectory ends with the first ``done``. An environment with
    auto-reset does not return the last state, so the trajectory then ends one step
    earlier.

    Args:
        env: Environment of one world, as ``newton_qd.create("ant_uni")`` returns.
        policy: Function of an observation (no,) that returns an action (nu,). Or
            actions (steps, nu), or (worlds, steps, nu) for each world its own.
        key: Key of the resets. Every world gets its own part of it if there are
            several; one world starts as after ``env.reset(key)``. Or the state of one
            world, from which all worlds start.
        steps: Control steps; ``None``: as many as there are actions, else the length
            of the environment's episode, or 1,000 if it has none.
        worlds: Number of worlds; ``None``: as many as there are plans of actions, or 1.
        params: Physical parameters of all worlds; ``None``: the default ones.
        contacts: Whether to record the impulse of every contact. It takes about twice
            as long.
        labels: Name of each world; ``None``: their numbers.

    Raises:
        TypeError: The environment cannot be drawn, or an argument has the wrong type.
        ValueError: The environment or the state has a batch, or the state is one of
            another environment. The actions have the wrong shape, ``steps`` or
            ``worlds`` is not an integer above 0, there are fewer actions than
            ``steps``, or the trajectory does not fit in memory.
        RobotDescriptionError: A URDF file is malformed.
        OSError: A URDF file cannot be read.
    """
    drawing = drawing_of(env)
    if isinstance(key, State):
        _require_own(env, key)
    else:
        require_key("key", key)
    checks.integer("steps", steps, optional=True)
    checks.integer("worlds", worlds, optional=True)
    plan = None
    if not callable(policy):
        plan, worlds = _checked_plan(env, policy, worlds)
        if steps is not None and steps > plan.shape[1]:
            allowed = (
                f"None, or integers from 1 to {plan.shape[1]}, as there are actions"
            )
            raise ValueError(message("steps", steps, allowed))
        steps = plan.shape[1] if steps is None else steps
    if steps is None:
        steps = _episode_steps(env)
    worlds = 1 if worlds is None else worlds
    check_memory(env, steps, worlds)
    starts = _starts(key, worlds)
    acts = (lambda _, observation: policy(observation)) if callable(policy) else None
    run = functools.partial(_run, env, acts, params, contacts, steps)
    if plan is not None:
        plan = plan[:, :steps]
    seen = jax.jit(jax.vmap(run))(starts, None, plan)
    seen = jax.tree.map(np.asarray, seen)
    return _trajectory(env, drawing, seen, labels)


def _require_own(env: Env, state: State) -> None:
    """Checks that the argument ``key`` is a state of one world of an environment.

    Raises:
        TypeError: A part of it has the wrong type or precision.
        ValueError: It has a batch, or is one of another environment.
    """
    if jnp.ndim(state.done):
        given = Fact(f"a state of a batch of shape {jnp.shape(state.done)}")
        raise ValueError(message("key", given, "a key, or the state of one world"))
    action = jax.ShapeDtypeStruct((env.action_size,), env.dtype)
    try:
        jax.eval_shape(env.step, state, action)
    except (TypeError, ValueError) as error:
        text = str(error)
        if not text.startswith("state"):
            raise
        # who records knows the state by the name of the argument here
        raise type(error)("key" + text.removeprefix("state")) from error


def _starts(key: RNGKey | State, worlds: int) -> PyTree:
    """Returns a key or a state for each world, leaves (worlds, ...)."""
    if isinstance(key, State):
        return jax.tree.map(lambda x: jnp.stack([x] * worlds), key)
    return key[None] if worlds == 1 else jax.random.split(key, worlds)


def check_memory(env: Env, steps: int, worlds: int) -> None:
    """Checks that a trajectory can fit in memory.

    Args:
        env: Environment of one world.
        steps: Control steps.
        worlds: Number of worlds.

    Raises:
        ValueError: It cannot.
    """
    # actions, and about as many numbers as an observation has
    needed = 4 * (env.action_size + env.observation_size) * steps * worlds
    memory.check("steps, worlds", (steps, worlds), needed, memory.limit())


class Recorder:
    """Records many policies of one shape from one start, batch by batch.

    A batch is compiled once.
    """

    def __init__(
        self,
        env: Env,
        policy: Callable[[PyTree, Observation], Action],
        steps: int,
        *,
        contacts: bool = False,
    ) -> None:
        """Prepares the recording.

        Args:
            env: Environment of one world.
            policy: Function of the parameters of a policy and an observation (no,)
                that returns an action (nu,).
            steps: Control steps.
            contacts: Whether to record the impulse of every contact.

        Raises:
            TypeError: The environment cannot be drawn, or ``policy`` is no function.
            ValueError: ``steps`` is not an integer above 0.
            RobotDescriptionError: A URDF file is malformed.
            OSError: A URDF file cannot be read.
        """
        checks.function("policy", policy, "a function of parameters and an observation")
        checks.integer("steps", steps)
        self.env = env
        self.drawing = drawing_of(env)
        run = functools.partial(_run, env, policy, None, contacts, steps)
        self._batch = jax.jit(jax.vmap(run, (None, 0, None)))

    def __call__(
        self, parameters: PyTree, key: RNGKey, labels: Sequence[str]
    ) -> Trajectory:
        """Records a batch of policies; all worlds start as after ``env.reset(key)``.

        Args:
            parameters: Parameters, leaves (worlds, ...).
            key: Key of the reset.
            labels: Name of each world.
        """
        seen = jax.tree.map(np.asarray, self._batch(key, parameters, None))
        return _trajectory(self.env, self.drawing, seen, labels)


def _episode_steps(env: Env) -> int:
    """Returns the steps of an episode."""
    length = getattr(env, "episode_length", None)
    if length is None:
        return _STEPS
    return math.ceil(length / getattr(env, "action_repeat", 1))


def _checked_plan(
    env: Env, actions: object, worlds: int | None
) -> tuple[jax.Array, int]:
    """Returns the actions (worlds, steps, nu) and the number of worlds.

    Raises:
        TypeError: They are not an array.
        ValueError: They have the wrong shape, or there are not as many as worlds.
    """
    size = env.action_size
    allowed = f"a function of an observation, or an array (steps, {size})"
    if not checks.is_array(actions):
        raise TypeError(message("policy", actions, allowed))
    plan = jnp.asarray(actions, env.dtype)
    if plan.ndim == 2:
        plan = jnp.broadcast_to(plan, (worlds or 1, *plan.shape))
    fits = plan.ndim == 3 and plan.shape[2] == size and plan.shape[1] > 0
    if not fits or (worlds or plan.shape[0]) != plan.shape[0]:
        allowed += f" or (worlds, steps, {size})"
        raise ValueError(message("policy", actions, allowed))
    return plan, plan.shape[0]


def _run(
    env: Env,
    policy: Callable[[PyTree, Observation], Action] | None,
    params: Params,
    contacts: bool,
    steps: int,
    key: RNGKey | State,
    parameters: PyTree,
    plan: jax.Array | None,
) -> tuple[dict[str, jax.Array], dict[str, jax.Array]]:
    """Runs one world; returns what is seen after the reset, and after each step.

    Raises:
        ValueError: The environment has a batch; or contacts are recorded, and the world
            has physical parameters.
    """
    first = key if isinstance(key, State) else env.reset(key)
    if contacts and (params is not None or "params" in first.info):
        why = "and contacts are computed without physical parameters"
        raise ValueError(message("contacts", contacts, "False", why=why))
    if jnp.ndim(first.done):
        given = Fact(f"an environment of {jnp.shape(first.done)[0]} worlds")
        allowed = "environments of one world, and worlds=N for more"
        raise ValueError(message("env", given, allowed))

    def body(state: Any, action: jax.Array | None) -> tuple[Any, dict[str, jax.Array]]:
        if policy is not None:
            action = policy(parameters, state.obs)
        assert action is not None
        action = jnp.asarray(action, env.dtype)
        begin = state.pipeline_state
        # the step of a user's environment may have no parameters
        step: Callable[..., Any] = env.step
        after = step(state, action) if params is None else step(state, action, params)
        seen = _seen(env, after)
        if contacts:
            seen["impulse"] = _impulses(env, begin, action)
        return after, seen

    _, frames = jax.lax.scan(body, first, plan, length=steps)
    return _seen(env, first), frames


def _seen(env: Env, state: Any) -> dict[str, jax.Array]:
    """Returns what a trajectory keeps of a state."""
    base, dtype = env.unwrapped, jnp.float32
    seen = {"reward": state.reward, "done": state.done}
    empty = jnp.zeros((0,), dtype)
    seen["descriptor"] = state.info.get("state_descriptor", empty)
    if isinstance(base, PhysicsEnv):
        seen["q"] = state.pipeline_state.q
        seen["feet"] = state.pipeline_state.feet_contact
    else:
        seen["q"], seen["feet"] = state.obs, empty
    return {name: value.astype(dtype) for name, value in seen.items()}


def _impulses(env: Env, begin: Any, action: jax.Array) -> jax.Array:
    """Returns the impulse of each contact (nc, 3) over the control step [N s]."""
    base = env.unwrapped
    if not isinstance(base, PhysicsEnv):
        return jnp.zeros((0, 3), jnp.float32)
    control = base.control(begin, action)
    impulse, _ = physics.contact_impulses(base.system, begin, control)
    return impulse.sum(axis=0).astype(jnp.float32)


def _trajectory(
    env: Env, drawing: Drawing, seen: tuple[dict, dict], labels: Sequence[str] | None
) -> Trajectory:
    """Returns the trajectory of recorded arrays (worlds, ...), (worlds, steps, ...)."""
    first, later = seen
    worlds, steps = later["done"].shape
    ended = later["done"] > 0
    lengths = np.where(ended.any(axis=1), ended.argmax(axis=1) + 1, steps)
    if _resets_itself(env):
        # the frame of the last step shows the next episode
        lengths = np.where(ended.any(axis=1), lengths - 1, lengths)

    def frames(name: str) -> np.ndarray:
        return np.concatenate([first[name][:, None], later[name]], axis=1)

    if labels is None:
        labels = [f"world {index + 1}" for index in range(worlds)]
    found = None
    if "impulse" in later and isinstance(env.unwrapped, PhysicsEnv):
        system = env.unwrapped.system
        found = Contacts(
            body=system.contact_body,
            position=system.contact_position,
            radius=system.contact_radius,
            ground=system.contact_obstacle == 0,
            impulse=later["impulse"],
        )
    return Trajectory(
        drawing=dataclasses.replace(drawing, name=env.name),
        q=frames("q"),
        lengths=np.maximum(lengths, 1).astype(np.int32),
        dt=float(env.dt),
        rewards=later["reward"],
        descriptors=frames("descriptor"),
        descriptor_names=component_names(env, first["descriptor"].shape[-1]),
        feet=frames("feet"),
        labels=tuple(labels),
        contacts=found,
    )


def _resets_itself(env: Any) -> bool:
    """Returns whether a wrapper returns finished worlds to their first state."""
    from newton_qd.wrappers import AutoResetWrapper

    while env is not env.unwrapped:
        if isinstance(env, AutoResetWrapper):
            return True
        env = env.env
    return False
