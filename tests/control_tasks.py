"""What the tests of the control tasks share: rollouts, and a second reckoning."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import newton_qd
from newton_qd.envs import PhysicsEnv
from newton_qd.envs.state import State
from newton_qd.physics import reference
from newton_qd.physics.system import PhysicsState

WORLDS, STEPS = 8, 6


@functools.cache
def make(name: str, **options: Any) -> Any:
    options = {"episode_length": None, "auto_reset": False, **options}
    return newton_qd.create(name, **options)


@functools.cache
def play(env: PhysicsEnv) -> Any:
    """Jitted function of states and actions (t, n, nu): states before and after."""

    def advance(state: State, action: jax.Array) -> tuple[State, tuple[State, State]]:
        after = jax.vmap(env.step)(state, action)
        return after, (state, after)

    return jax.jit(lambda s, a: jax.lax.scan(advance, s, a)[1])


def moving(env: PhysicsEnv, q: np.ndarray, v: np.ndarray) -> PhysicsState:
    """The physics of worlds of given coordinates (n, nq) and velocities (n, nv)."""
    state = functools.partial(newton_qd.physics.initial_state, env.system)
    arrays = (jnp.asarray(x, env.dtype) for x in (q, v))
    return jax.jit(jax.vmap(state))(*arrays)


def thrown(env: PhysicsEnv, worlds: int = WORLDS) -> tuple[State, np.ndarray]:
    """Random moving worlds, and actions that go beyond 1."""
    rng = np.random.default_rng(0)
    keys = jax.random.split(jax.random.key(0), worlds)
    state = jax.jit(jax.vmap(env.reset))(keys)
    q = np.array(state.pipeline_state.q)
    free = env.system.nq != env.system.nv
    if not free:
        q += rng.normal(size=q.shape) * 0.5
    v = rng.normal(size=(worlds, env.system.nv))
    actions = rng.uniform(-1.3, 1.3, (STEPS, worlds, env.action_size))
    state = state.replace(pipeline_state=moving(env, q, v))
    return state, actions.astype(env.dtype)


@functools.cache
def rolled(name: str, **options: Any) -> tuple[State, State, np.ndarray]:
    env = make(name, **options)
    state, actions = thrown(env)
    before, after = jax.tree.map(np.asarray, play(env)(state, actions))
    return before, after, actions


def bodies(name: str, state: State) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Frame (t, n, 7) and twist of the centre of mass (t, n, 6) of every link."""
    system = make(name).system
    q, v = state.pipeline_state.q, state.pipeline_state.v
    frames, twists = [], []
    for world_q, world_v in zip(
        q.reshape(-1, system.nq), v.reshape(-1, system.nv), strict=True
    ):
        linear, angular = reference.jacobians(system, world_q)
        frames.append(reference.body_frames(system, world_q))
        twists.append(np.concatenate([linear @ world_v, angular @ world_v], axis=1))
    shape = (*q.shape[:2], system.nb)
    found = np.array(frames).reshape(*shape, 7), np.array(twists).reshape(*shape, 6)
    return {
        link: (found[0][..., i, :], found[1][..., i, :])
        for i, link in enumerate(system.body_names)
    }


def point(frame: np.ndarray, offset: tuple[float, ...]) -> np.ndarray:
    """World position (t, n, 3) of a point of a link."""
    flat = [
        reference.compose(row, np.append(offset, [0, 0, 0, 1]))[:3]
        for row in frame.reshape(-1, 7)
    ]
    return np.array(flat).reshape(*frame.shape[:-1], 3)


def agree(found: Any, expected: Any, scale: float = 1.0) -> None:
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-5 * scale)


def metrics_are(state: State, expected: dict[str, Any]) -> None:
    assert set(state.metrics) == set(expected)
    for key, value in expected.items():
        agree(state.metrics[key], value, 5.0)
