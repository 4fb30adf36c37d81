"""The door between JAX and Warp: shared memory, tracing, and what is refused."""

from __future__ import annotations

import dataclasses
import functools
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import warp as wp

from newton_qd import physics
from newton_qd.physics.warp_internals import ffi_module
from newton_qd.robots import ANT

SYSTEM = physics.load_system(ANT)
REGISTRY = ffi_module()._FFI_CALLABLE_REGISTRY
RNG = np.random.default_rng(3)
ACTIONS = RNG.uniform(-1.0, 1.0, (2, 3, 8)).astype(np.float32)

# Two virtual devices must exist before JAX starts, hence a process of its own.
SHARDED = """
import warnings
warnings.filterwarnings("error", module="newton_qd|__main__")
import jax, jax.numpy as jnp, numpy as np
from jax.sharding import Mesh, PartitionSpec as P
from newton_qd import physics
from newton_qd.robots import ANT

assert len(jax.devices()) == 2
system = physics.load_system(ANT)
start = physics.initial_state(system, jnp.asarray(system.rest_q), jnp.zeros(14))
states = jax.tree.map(lambda x: jnp.tile(x, (4,) + x.ndim * (1,)), start)

def evaluate(states, actions):
    def advance(state, action):
        return physics.step(system, state, action)[0], None
    def episode(actions, state):
        return jax.lax.scan(advance, state, actions)[0].q.sum()
    return jax.vmap(jax.value_and_grad(episode))(actions, states)

rng = np.random.default_rng(0)
actions = jnp.asarray(rng.uniform(-1.0, 1.0, (4, 2, 8)), jnp.float32)
mesh = Mesh(np.array(jax.devices()), ("worlds",))
rows = P("worlds")
sharded = jax.shard_map(evaluate, mesh=mesh, in_specs=rows, out_specs=rows)
found = jax.jit(sharded)(states, actions)
expected = jax.jit(evaluate)(states, actions)
assert len(found[1].sharding.device_set) == 2
for ours, theirs in zip(found, expected, strict=True):
    np.testing.assert_array_equal(ours, theirs)
print("equal")
"""


@functools.cache
def start() -> physics.PhysicsState:
    """The state at rest, in float32."""
    rest, still = np.asarray(SYSTEM.rest_q, np.float32), np.zeros(14, np.float32)
    with jax.ensure_compile_time_eval():
        return jax.jit(lambda: physics.initial_state(SYSTEM, rest, still))()  # pyright: ignore[reportArgumentType]


def advance(action: jax.Array) -> jax.Array:
    """Coordinates (nq,) after a control step from rest."""
    return physics.step(SYSTEM, start(), action)[0].q


def warp_device(device: jax.Device) -> str:
    return "cpu" if device.platform == "cpu" else "cuda:0"


@pytest.mark.parametrize(
    ("dtype", "shape", "expected"),
    [
        (wp.float32, (3,), (3,)),
        (wp.float32, (5, 3), (5, 3)),
        (wp.vec3, (4,), (4, 3)),
        (wp.transform, (2, 2), (2, 2, 7)),
        (wp.int32, (6,), (6,)),
    ],
)
def test_to_jax_shares_memory(
    device: jax.Device, dtype: Any, shape: tuple[int, ...], expected: tuple[int, ...]
) -> None:
    array = wp.ones(shape, dtype=dtype, device=warp_device(device))
    view = physics.to_jax(array)
    assert view.shape == expected
    assert view.dtype == (jnp.int32 if dtype is wp.int32 else jnp.float32)
    assert view.unsafe_buffer_pointer() == array.ptr
    assert view.devices() == {device}
    np.testing.assert_array_equal(view, array.numpy())


def test_from_jax_shares_memory(device: jax.Device) -> None:
    array = jnp.arange(24, dtype=jnp.float32).reshape(2, 4, 3)
    plain = physics.from_jax(array)
    vectors = physics.from_jax(array, wp.vec3)
    assert plain.shape == (2, 4, 3) and plain.dtype is wp.float32
    assert vectors.shape == (2, 4) and vectors.dtype is wp.vec3
    assert plain.ptr == vectors.ptr == array.unsafe_buffer_pointer()
    assert str(plain.device) == warp_device(device)
    np.testing.assert_array_equal(vectors.numpy(), array)


def test_views_outlive_what_they_were_made_of(device: jax.Device) -> None:
    array = wp.full(1000, 7.0, dtype=wp.float32, device=warp_device(device))
    view = physics.to_jax(array)
    again = physics.from_jax(view)
    del array, view
    wp.full(1000, 1.0, dtype=wp.float32, device=warp_device(device))
    assert (again.numpy() == 7.0).all()


def test_round_trip_through_a_kernel(device: jax.Device) -> None:
    """What Warp writes, JAX sees, once it has been handed over."""
    source = jnp.arange(8.0, dtype=jnp.float32) + 1.0
    target = wp.zeros(8, dtype=wp.float32, device=warp_device(device))
    wp.copy(target, physics.from_jax(source))
    np.testing.assert_array_equal(physics.to_jax(target) * 2.0, source * 2.0)


def test_traced_arrays_have_no_memory() -> None:
    with pytest.raises(TypeError, match="from_jax: array: got a traced one"):
        jax.jit(lambda x: physics.from_jax(x) and x)(jnp.zeros(3))
    with pytest.raises(TypeError, match="from_jax: array: got a traced one"):
        jax.grad(lambda x: physics.from_jax(x) and x.sum())(jnp.zeros(3))


@pytest.mark.optimized
def test_nested_vmap() -> None:
    """Worlds of any nesting are one batch; each row equals the world alone."""
    alone = jax.jit(advance)
    nested = jax.jit(jax.vmap(jax.vmap(advance)))(ACTIONS)
    assert nested.shape == (2, 3, 15)
    for index in np.ndindex(2, 3):
        np.testing.assert_array_equal(nested[index], alone(ACTIONS[index]))
    turned = jax.jit(jax.vmap(jax.vmap(advance, in_axes=1, out_axes=1)))(
        ACTIONS.transpose(0, 2, 1)
    )
    np.testing.assert_array_equal(turned, nested.transpose(0, 2, 1))


@pytest.mark.optimized
def test_vmap_over_some_arguments() -> None:
    """Unbatched arguments are shared by the worlds."""
    states = jax.vmap(lambda x: physics.initial_state(SYSTEM, x, jnp.zeros(14)))(
        jnp.stack([start().q, start().q + jnp.eye(15)[2]])
    )

    def step(state: physics.PhysicsState, action: jax.Array) -> jax.Array:
        return physics.step(SYSTEM, state, action)[0].v

    action = jnp.asarray(ACTIONS[0, 0])
    many = jax.jit(jax.vmap(step, in_axes=(0, None)))(states, action)
    for world in range(2):
        state = jax.tree.map(lambda x, world=world: x[world], states)
        np.testing.assert_array_equal(many[world], jax.jit(step)(state, action))


@pytest.mark.optimized
@pytest.mark.slow
def test_derivatives_under_vmap() -> None:
    """vmap of grad, grad of vmap and the rows of a Jacobian agree."""

    def total(action: jax.Array) -> jax.Array:
        return advance(action).sum()

    actions = jnp.asarray(ACTIONS[0])
    inside = jax.jit(jax.vmap(jax.grad(total)))(actions)
    outside = jax.jit(jax.grad(lambda a: jax.vmap(total)(a).sum()))(actions)
    rows = jax.jit(jax.vmap(jax.jacrev(advance)))(actions)
    assert rows.shape == (3, 15, 8)
    assert float(jnp.abs(inside).max()) > 0.0
    np.testing.assert_array_equal(inside, outside)
    np.testing.assert_allclose(rows.sum(1), inside, rtol=1e-4, atol=1e-6)


def test_calls_are_not_traced_again() -> None:
    traces = 0

    @jax.jit
    def step(state: physics.PhysicsState, action: jax.Array) -> physics.PhysicsState:
        nonlocal traces
        traces += 1
        return physics.step(SYSTEM, state, action)[0]

    state = start()
    for _ in range(10):
        state = step(state, jnp.asarray(ACTIONS[0, 0]))
    assert traces == 1


def numbered_calls() -> int:
    """Calls that Warp has seen; it keeps each, and XLA compiles each."""
    return sum(len(call.call_descriptors) for call in REGISTRY.values())


def test_eager_calls_are_not_compiled_again() -> None:
    def everything() -> None:
        state, _ = physics.step(SYSTEM, start(), jnp.asarray(ACTIONS[0, 0]))
        physics.forward_kinematics(SYSTEM, state.q, state.v)
        physics.bias_forces(SYSTEM, state.q, state.v)
        jax.grad(lambda a: advance(a).sum())(jnp.asarray(ACTIONS[0, 0]))
        jax.vmap(advance)(jnp.asarray(ACTIONS[0]))

    everything()
    before = numbered_calls()
    everything()
    assert numbered_calls() == before


@pytest.mark.parametrize("transform", [jax.jacfwd, jax.hessian])
def test_no_forward_mode(transform: Any) -> None:
    message = r"can't apply forward-mode autodiff \(jvp\) to a custom_vjp function"
    with pytest.raises(TypeError, match=message):
        transform(lambda a: advance(a).sum())(jnp.asarray(ACTIONS[0, 0]))
    with pytest.raises(TypeError, match=r"use jax.grad, jax.vjp or jax.jacrev instead"):
        jax.jit(transform(lambda a: advance(a).sum()))(jnp.asarray(ACTIONS[0, 0]))


def test_no_forward_mode_inside_of_a_gradient() -> None:
    """As in the product of a Hessian and a vector."""
    action = jnp.asarray(ACTIONS[0, 0])

    def slope(a: jax.Array) -> jax.Array:
        return jax.jvp(lambda x: advance(x).sum(), (a,), (a,))[1]

    for again in (jax.grad(slope), jax.jit(jax.grad(slope))):
        with pytest.raises(TypeError, match=r"first derivatives in reverse mode only"):
            again(action)


def test_no_second_derivative() -> None:
    def first(action: jax.Array) -> jax.Array:
        return jax.grad(lambda a: advance(a).sum())(action).sum()

    with pytest.raises(TypeError, match=r"first derivatives only: .*lax.stop_gradient"):
        jax.grad(first)(jnp.asarray(ACTIONS[0, 0]))


def test_functions_without_a_derivative() -> None:
    """JAX's own error names neither the function nor the cure."""
    here, action = start(), jnp.asarray(ACTIONS[0, 0])

    def impulses(q: jax.Array) -> jax.Array:
        state = dataclasses.replace(here, q=q)
        return physics.contact_impulses(SYSTEM, state, action)[1]

    for name, read in {
        "mass_matrix": lambda q: physics.mass_matrix(SYSTEM, q),
        "bias_forces": lambda q: physics.bias_forces(SYSTEM, q, here.v),
        "contact_gaps": lambda q: physics.contact_gaps(SYSTEM, q),
        "contact_impulses": impulses,
    }.items():
        words = rf"^there is no derivative of physics\..*{name}.*: .*stop_gradient"

        def loss(q: jax.Array, read: Any = read) -> jax.Array:
            return read(q).sum()

        for derived in (jax.grad(loss), jax.jacfwd(loss)):
            with pytest.raises(TypeError, match=words):
                jax.eval_shape(derived, here.q)


def test_gaps_may_be_constant_in_a_loss() -> None:
    """The cure that the error names."""

    def loss(q: jax.Array) -> jax.Array:
        gaps = physics.contact_gaps(SYSTEM, jax.lax.stop_gradient(q))
        return gaps.sum() * q.sum()

    q = start().q
    np.testing.assert_allclose(
        jax.jit(jax.vmap(jax.grad(loss)))(q[None])[0],
        physics.contact_gaps(SYSTEM, q).sum() * jnp.ones_like(q),
        rtol=1e-6,
    )


def test_an_inner_gradient_may_be_constant() -> None:
    """The cure that the error names."""
    action = jnp.asarray(ACTIONS[0, 0])
    first = jax.grad(lambda a: advance(a).sum())

    def product(a: jax.Array) -> jax.Array:
        return advance(a).sum() * first(jax.lax.stop_gradient(a)).sum()

    def stopped(a: jax.Array) -> jax.Array:
        return advance(a).sum() * jax.lax.stop_gradient(first(a)).sum()

    for loss in (product, stopped):
        np.testing.assert_allclose(
            jax.grad(loss)(action), first(action) * first(action).sum(), rtol=1e-6
        )

    def told(a: jax.Array) -> tuple[jax.Array, jax.Array]:
        return advance(a).sum(), jnp.linalg.norm(first(a))

    slope, size = jax.jit(jax.grad(told, has_aux=True))(action)
    np.testing.assert_allclose(slope, first(action), rtol=1e-6)
    assert size == pytest.approx(float(jnp.linalg.norm(slope)), rel=1e-5)


def test_wrong_precision(x64: None) -> None:
    with pytest.raises(TypeError, match=r"control: got .*float64; .*float32"):
        physics.step(SYSTEM, start(), jnp.zeros(8, jnp.float64))


@pytest.mark.optimized
@pytest.mark.slow
def test_shards_of_a_batch(tmp_path: Path, device: jax.Device) -> None:
    """Two devices of one process: the same values as one, gradients included."""
    if device.platform != "cpu":
        pytest.skip("virtual devices are CPU devices")
    flags = os.environ.get("XLA_FLAGS", "")
    environment = os.environ | {
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"{flags} --xla_force_host_platform_device_count=2",
    }
    script = tmp_path / "sharded.py"
    script.write_text(SHARDED, encoding="utf-8")
    result = subprocess.run(
        [sys.executable, str(script)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stdout.endswith("equal\n")
