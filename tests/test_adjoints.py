"""The adjoint of every environment: to all that it depends on, however it is asked for.

Every simulated robot and task, from states in and out of contact: the gradients of
reward, observation, state descriptor and contact impulses with respect to coordinates,
velocities, actions and each physical parameter. They agree with central differences,
with one another under every transformation of JAX, and with Warp's tape.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp as wp
from adjoint_helpers import (
    INPUTS,
    Inputs,
    along,
    inputs_of,
    make,
    norms,
    readings,
    simulated,
    weighted,
    weights_of,
)
from physics_helpers import random_states, report

import newton_qd
from newton_qd import physics
from newton_qd.envs.state import State
from newton_qd.physics import bridge, buffers
from newton_qd.physics.launch import output_size
from newton_qd.physics.precision import pack_width
from newton_qd.physics.system import System
from newton_qd.robots import ANT, HALFCHEETAH, RobotSpec

# of the differences; the one that agrees best counts, and the largest is for gravity,
# on which the readings of a step depend 1e5 times less than their size
DISTANCES = (1e-3, 1e-4, 1e-5, 1e-6)

# of each robot the task that came last, with its wrappers
EACH_ROBOT = list({urdf: name for name, urdf in simulated().items()}.values())


@pytest.mark.slow
@pytest.mark.parametrize("name", simulated())
def test_a_step_of_every_environment(x64: None, name: str) -> None:
    """Along a random direction of every input: relative error below 1e-6."""
    env = make(name)
    inputs, rng = inputs_of(env), np.random.default_rng(2)
    # one program: compiling it takes longer than all gradients that are not needed
    several = jax.jit(jax.vmap(jax.value_and_grad(weighted(env))))
    exact = several(inputs)[1]
    worst = {}
    for part in INPUTS:
        direction = rng.normal(size=inputs[part].shape)
        size = norms(exact[part]) * norms(direction)
        felt = size > 0
        errors = []
        for distance in DISTANCES:
            ahead, behind = (
                several({**inputs, part: inputs[part] + sign * distance * direction})[0]
                for sign in (1, -1)
            )
            difference = np.asarray(ahead - behind) / (2 * distance)
            assert not difference[~felt].any(), part
            error = np.abs(difference - along(exact[part], direction))
            errors.append(error[felt] / size[felt])
        worst[part] = np.min(errors, axis=0).max(initial=0.0)
    report(f"{name}: largest relative errors", worst)
    assert max(worst.values()) < 1e-6
    for part in ("q", "v", "action", "gear_scale", "mass_scale"):
        assert norms(exact[part]).all(), part


def close(found: Any, expected: Any) -> None:
    """Equal up to the order in which XLA takes sums, part by part."""
    for part in INPUTS:
        a, b = np.asarray(found[part]), np.asarray(expected[part])
        atol = 1e-11 * (1 + np.abs(b).max())
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=atol, err_msg=part)


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_ROBOT)
def test_every_transformation_gives_the_same(x64: None, name: str) -> None:
    """Three steps in a scan; batched, nested, unrolled, remat, alone, Jacobian."""
    env = make(name)
    inputs, weigh = inputs_of(env, 4), weighted(env)

    def value(inputs: Inputs, unrolled: bool = False) -> jax.Array:
        return weigh(inputs, 3, unrolled)

    gradient = jax.grad(value)
    # as NumPy's: JAX would compile every slice of it
    inner = jax.device_get(jax.jit(jax.vmap(gradient))(inputs))
    close(jax.jit(jax.grad(lambda x: jax.vmap(value)(x).sum()))(inputs), inner)
    pairs = jax.tree.map(lambda x: x.reshape(2, 2, *x.shape[1:]), inputs)
    nested = jax.device_get(jax.jit(jax.vmap(jax.vmap(gradient)))(pairs))
    close(jax.tree.map(lambda x: x.reshape(4, *x.shape[2:]), nested), inner)
    close(jax.jit(jax.vmap(jax.grad(jax.checkpoint(value))))(inputs), inner)
    unrolled = jax.grad(functools.partial(value, unrolled=True))
    close(jax.jit(jax.vmap(unrolled))(inputs), inner)
    one, first = (jax.tree.map(lambda x: x[0], tree) for tree in (inputs, inner))
    close(jax.jit(gradient)(one), first)
    rows = jax.jit(jax.jacrev(lambda x: readings(env)(x, 3)))(one)
    weights = weights_of(len(rows["q"]))
    close(jax.tree.map(lambda x: np.tensordot(weights, x, 1), rows), first)


RESET, TOTAL = 3, 6  # steps of an episode, and of two


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hopper_uni", "antmaze"])
def test_no_gradient_crosses_an_auto_reset(x64: None, name: str) -> None:
    """Rewards of the second episode do not depend on actions of the first, exactly."""
    env = newton_qd.create(name, episode_length=RESET, dtype="float64")
    start = jax.jit(env.reset)(jax.random.key(0))
    half = np.random.default_rng(0).uniform(-1, 1, (RESET, env.action_size))

    def rewards(actions: jax.Array) -> jax.Array:
        def advance(state: State, action: jax.Array) -> tuple[State, jax.Array]:
            state = env.step(state, action)
            return state, jnp.stack([state.reward, state.obs.sum()])

        return jax.lax.scan(advance, start, actions)[1]

    rows = np.asarray(jax.jit(jax.jacrev(rewards))(jnp.asarray(np.tile(half, (2, 1)))))
    assert rows.shape == (TOTAL, 2, TOTAL, env.action_size)
    assert not rows[RESET:, :, :RESET].any()
    # the observation that an auto-reset returns is that of a reset
    assert not rows[RESET - 1, 1].any() and not rows[-1, 1].any()
    assert all(rows[step, 0, step].any() for step in range(TOTAL))
    np.testing.assert_array_equal(rows[RESET:, :, RESET:], rows[:RESET, :, :RESET])


STEPS = 4  # of the chain of tapes


def taped(system: System, x: np.ndarray, y_bar: np.ndarray) -> np.ndarray:
    """Adjoints of the inputs (n, inputs) of a step, as Warp's own tape finds them."""
    device = wp.get_device("cpu")
    packs = -(-len(x) // pack_width(system.dtype, device))
    model = buffers.build_model(system, device)
    scratch = buffers.build_scratch(system, packs, device, adjoint=True)
    rows = [wp.array(a.ravel(), dtype=wp.float64, device=device) for a in (x, y_bar)]
    x_bar = wp.zeros(x.size, dtype=wp.float64, device=device)
    held = (scratch.values, scratch.adjoints)
    with wp.Tape() as tape:
        wp.launch(
            buffers.kernels_of(system, device).backward.step_backward,
            dim=packs,
            inputs=[model, 0, 1, len(x), 1, *held, *rows, x_bar],
            device=device,
            block_dim=1,
        )
    tape.backward()
    return x_bar.numpy().reshape(x.shape)


def size_of(system: System) -> int:
    """Numbers of a state."""
    return system.nq + system.nv


def chained(system: System, x: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Adjoints of the inputs of four steps whose outputs are weighted, by tapes."""
    state, rows = size_of(system), [x]
    y = wp.zeros(len(x) * output_size(system), dtype=wp.float64, device="cpu")
    launcher = bridge.launcher(system, wp.get_device("cpu"))
    for _ in range(STEPS - 1):
        launcher.forward(len(x), wp.array(rows[-1].ravel(), device="cpu"), y)
        after = y.numpy().reshape(len(x), -1)[:, :state]
        rows.append(np.concatenate([after, x[:, state:]], axis=1))
    total = np.zeros_like(x)
    for row in reversed(rows):
        y_bar = np.zeros((len(x), output_size(system)))
        y_bar[:, : len(weights)] = weights
        y_bar[:, :state] += total[:, :state]
        x_bar = taped(system, row, y_bar)
        total = np.concatenate(
            [x_bar[:, :state], x_bar[:, state:] + total[:, state:]], 1
        )
    return total


@pytest.mark.slow
@pytest.mark.parametrize("robot", [ANT, HALFCHEETAH], ids=lambda robot: robot.name)
def test_the_bridge_agrees_with_a_tape(
    x64: None, device: Any, robot: RobotSpec
) -> None:
    """Four control steps: the chain of Warp's tapes is ``jax.grad``, to 1e-6."""
    if device.platform != "cpu":
        pytest.skip("the tape is launched on a CPU")
    system = physics.load_system(robot, "float64")
    inputs = random_states(system, np.random.default_rng(0), 6)
    weights = np.random.default_rng(1).normal(size=size_of(system) + 7 * system.nb)
    kept = jnp.asarray(weights)

    def value(q: jax.Array, v: jax.Array, control: jax.Array) -> jax.Array:
        def advance(state: Any, _: None) -> tuple[Any, jax.Array]:
            state, _fault = physics.step(system, state, control)
            parts = (state.q, state.v, state.impulse.ravel(), state.normal_impulse)
            return state, kept @ jnp.concatenate(parts)

        start = physics.initial_state(system, q, v)
        return jax.lax.scan(advance, start, None, length=STEPS)[1].sum()

    expected = jax.jit(jax.vmap(jax.grad(value, argnums=(0, 1, 2))))(*inputs)
    expected = np.concatenate(expected, axis=1)
    found = chained(system, np.concatenate(inputs, axis=1), weights)
    error = norms(found - expected) / norms(expected)
    report("largest relative difference", error.max())
    assert error.max() < 1e-6
