"""Checks of the methods that a subclass of ``PhysicsEnv`` overrides."""

from __future__ import annotations

import jax

from newton_qd.envs.base import Env, PhysicsEnv
from newton_qd.envs.inputs import require_vector


def check_methods(env: Env) -> None:
    """Checks the shapes that ``control`` and ``reset_pose`` return; computes nothing.

    The constructor checks ``observe`` and ``outcome``. These two come later, because
    they may read attributes that a subclass sets after ``super().__init__``.

    Args:
        env: Environment without wrappers. Only simulated robots have these methods.

    Raises:
        TypeError: A method does not return an array.
        ValueError: A method returns a wrong shape.
    """
    if not isinstance(env, PhysicsEnv):
        return
    kind, system = type(env).__name__, env.system
    rest = jax.eval_shape(env.fixed_state).pipeline_state
    action = jax.ShapeDtypeStruct((env.action_size,), env.dtype)
    found = jax.eval_shape(env.control, rest, action)
    meaning = "the control of the actuators"
    require_vector(f"{kind}.control", found, system.nu, meaning=meaning)
    found = jax.eval_shape(env.reset_pose, random_key(), rest.q)
    require_vector(f"{kind}.reset_pose", found, system.nq, meaning="the coordinates")


def random_key() -> jax.ShapeDtypeStruct:
    """Returns the shape and the type of a random key."""
    return jax.eval_shape(lambda: jax.random.key(0))
