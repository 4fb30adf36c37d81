"""Plans of actions: the physics of all steps at once, then what is read from it.

The wrappers and the environment say in ``rollout_order`` how their steps may be run.
"""

from __future__ import annotations

import enum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd import checks
from newton_qd.checks import message
from newton_qd.envs import inputs
from newton_qd.envs.state import State
from newton_qd.physics.explicit_mesh import split_as
from newton_qd.physics.step import Foreseen
from newton_qd.physics.step import rollout as physics_rollout
from newton_qd.types import Action, Params


class RolloutOrder(enum.IntEnum):
    """How the steps of a plan may be run when the plan is known at the start.

    A class that overrides ``step``, ``control`` or ``describe`` sets its own
    ``rollout_order``. Without one, its steps run one by one, or in order if it only has
    another ``describe``.
    """

    AT_ONCE = 0
    """A step reads the physics before and after it, the action, and constant info."""
    IN_ORDER = 1
    """A step also reads what the step before has written, such as a count."""
    ONE_BY_ONE = 2
    """A step may change the state or the control of the physics."""


_UNLESS_SAID = {
    "step": RolloutOrder.ONE_BY_ONE,
    "control": RolloutOrder.ONE_BY_ONE,
    "describe": RolloutOrder.IN_ORDER,  # it may read the last state descriptor
}
"""The order of a class with its own version of a method, unless it says another."""


def rollout(env: Any, state: State, actions: Action, params: Params) -> State:
    """Runs a plan of actions: see :meth:`~newton_qd.envs.env.Env.rollout`.

    Raises:
        TypeError: The state or an action has the wrong type.
        ValueError: The state, the actions or ``params`` do not fit the environment, or
            it is float64 and JAX x64 is off.
    """
    if not hasattr(state, "done"):  # a class of a user may have states of its own
        inputs.require_state(state)
    # a wrapper around a batch: ``VectorWrapper`` itself has a ``rollout`` of its own
    batched = getattr(env, "batch_size", None) is not None
    shape = (*(jnp.shape(state.done) if batched else ()), env.action_size)
    allowed = f"an array of shape (steps, {', '.join(map(str, shape))})"
    checks.instance("actions", actions, (jax.Array, np.ndarray), allowed)
    if jnp.ndim(actions) == 0 or jnp.shape(actions)[1:] != shape:
        raise ValueError(message("actions", actions, allowed))
    order = RolloutOrder.ONE_BY_ONE if batched else _order(env)
    if order == RolloutOrder.ONE_BY_ONE:
        return _in_order(env, state, actions, params, known=False)
    base = env.unwrapped
    checks.x64(base.dtype)
    inputs.require_robot_state(state, base.system, ())
    actions = jax.vmap(
        lambda action: checks.array("actions", action, (base.action_size,), base.dtype)
    )(actions)
    given = (state, actions, params)
    state, actions, params = split_as([state.obs, actions], given)
    known = _foresee(base, state, actions, params)
    if order == RolloutOrder.IN_ORDER:
        return _in_order(env, state, actions, known, known=True)
    return _at_once(env, state, actions, known)


def _order(env: Any) -> RolloutOrder:
    """Returns the slowest order of an environment and its wrappers."""
    orders, inside = [], env
    while True:
        orders.append(_own_order(inside))
        if inside is env.unwrapped:
            return max(orders)
        inside = inside.env


def _own_order(env: Any) -> RolloutOrder:
    """Returns the order of an environment without those inside it.

    A class that overrides a method may need another order than its base class has.
    """
    kinds = type(env).__mro__
    orders = [getattr(env, "rollout_order", RolloutOrder.ONE_BY_ONE)]
    for name, order in _UNLESS_SAID.items():
        for kind in kinds:
            if "rollout_order" in vars(kind):  # said of this method, or of a newer one
                break
            if name in vars(kind):
                orders.append(order)
                break
    return max(orders)


def _in_order(
    env: Any, state: State, actions: Action, params: Params, *, known: bool
) -> State:
    def advance(state: State, row: tuple[Action, Params]) -> tuple[State, State]:
        action, foreseen = row
        after = env.step(state, action, foreseen if known else params)
        after = split_as([state.reward, action], after)
        return after, after

    rows = (actions, params if known else None)
    state = split_as([state.reward, jnp.asarray(actions)], state)
    return jax.lax.scan(advance, state, rows)[1]


def _foresee(base: Any, state: State, actions: Action, params: Params) -> Foreseen:
    """Runs the physics of a :class:`~newton_qd.envs.base.PhysicsEnv` for a plan."""
    start = state.pipeline_state
    controls = jax.vmap(base.control, (None, 0))(start, actions)
    controls = jnp.asarray(controls, base.dtype)
    # as in ``PhysicsEnv.step``: such a control tells the physics to freeze a world
    sound = jnp.all(jnp.isfinite(actions), axis=1) & (state.info["fault"] == 0)
    controls = jnp.where(sound[:, None], controls, jnp.nan)
    return physics_rollout(base.system, start, controls, params)


def _at_once(env: Any, state: State, actions: Action, known: Foreseen) -> State:
    """Reads all steps side by side, as if they were worlds of a batch."""

    def before(first: jax.Array, after: jax.Array) -> jax.Array:
        return jnp.concatenate([jnp.asarray(first, after.dtype)[None], after[:-1]])

    def step(start: Any, fault: jax.Array, action: Action, after: Foreseen) -> State:
        info = {**state.info, "fault": fault}
        begin = state.replace(pipeline_state=start, info=info)
        return env.step(begin, action, after)

    if not len(actions):
        return _in_order(env, state, actions, known, known=True)
    starts = jax.tree.map(before, state.pipeline_state, known.after)
    faults = before(state.info["fault"], known.fault)
    return jax.vmap(step)(starts, faults, actions, known)
