"""The one door between JAX and Warp.

Traced code calls the kernels through XLA's foreign function interface; a batch of
any nesting arrives as one launch with a leading world axis. Eager code shares memory
through DLPack. No other module knows both libraries.
"""

import contextlib
import functools
from collections.abc import Iterator
from typing import Any

import jax
import warp as wp
from warp._src.jax.ffi import FfiCallable

from newton_qd.physics import interrupts
from newton_qd.physics.launch import Launcher
from newton_qd.physics.precision import SCALARS, kernels
from newton_qd.physics.system import System


@functools.cache
def _launcher(system: System, alias: str) -> Launcher:
    return Launcher(system, wp.get_device(alias))


def launcher(system: System, device: Any) -> Launcher:
    """The launcher of ``system`` on a Warp device; made once."""
    return _launcher(system, device.alias)


@contextlib.contextmanager
def _errors_contained() -> Iterator[None]:
    """Turn what Warp would let through XLA's frames into an error that it reports."""
    try:
        yield
    except Exception:
        raise
    except BaseException as error:
        raise RuntimeError(f"interrupted inside the physics: {error!r}") from error


def _callable(function: Any, outputs: int, module: Any) -> Any:
    """Register a function that launches kernels of ``module`` as an XLA custom call."""
    # Warp loads the module of the function when a call is traced: the kernels' one
    function.__module__ = module.__name__
    return wp.jax_callable(
        function,
        num_outputs=outputs,
        vmap_method="broadcast_all",
        graph_mode=wp.JaxCallableGraphMode.NONE,
    )


def _fill(struct: Any, **arrays: Any) -> Any:
    """Set the named arrays of a Warp struct."""
    for name, array in arrays.items():
        setattr(struct, name, array)
    return struct


@functools.cache
def _forward_call(system: System) -> Any:
    real = SCALARS[system.dtype]
    world = kernels(system.dtype).world

    def step_forward(
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        ctrl: wp.array2d(dtype=real),
        q_new: wp.array2d(dtype=real),
        v_new: wp.array2d(dtype=real),
        impulse: wp.array3d(dtype=real),
        normal_impulse: wp.array2d(dtype=real),
        fault: wp.array1d(dtype=real),
    ):
        values = _fill(
            world.Values(),
            q=q,
            v=v,
            ctrl=ctrl,
            q_new=q_new,
            v_new=v_new,
            impulse=impulse,
            normal_impulse=normal_impulse,
            fault=fault,
        )
        with _errors_contained():
            launcher(system, q.device).forward(q.shape[0], values)

    return _callable(step_forward, 5, kernels(system.dtype).forward)


@functools.cache
def _backward_call(system: System) -> Any:
    real = SCALARS[system.dtype]
    world = kernels(system.dtype).world

    def step_backward(
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        ctrl: wp.array2d(dtype=real),
        q_new_bar: wp.array2d(dtype=real),
        v_new_bar: wp.array2d(dtype=real),
        impulse_bar: wp.array3d(dtype=real),
        normal_impulse_bar: wp.array2d(dtype=real),
        q_bar: wp.array2d(dtype=real),
        v_bar: wp.array2d(dtype=real),
        ctrl_bar: wp.array2d(dtype=real),
    ):
        adjoints = _fill(
            world.Values(),
            q=q_bar,
            v=v_bar,
            ctrl=ctrl_bar,
            q_new=q_new_bar,
            v_new=v_new_bar,
            impulse=impulse_bar,
            normal_impulse=normal_impulse_bar,
        )
        values = _fill(world.Values(), q=q, v=v, ctrl=ctrl)
        with _errors_contained():
            launcher(system, q.device).backward(q.shape[0], values, adjoints)

    return _callable(step_backward, 3, kernels(system.dtype).backward)


@functools.cache
def control_step(system: System) -> Any:
    """The differentiable control step of one world.

    Args:
        system: The system.

    Returns:
        A function of ``q`` (nq,), ``v`` (nv,), ``control`` (nu,) that returns
        ``q`` (nq,), ``v`` (nv,), ``impulse`` (nb, 6), ``normal_impulse`` (nb,) and
        ``fault`` () as in :class:`~newton_qd.physics.system.PhysicsState`; reverse
        mode once, no forward mode. Under ``vmap`` the worlds share one launch.
    """
    interrupts.install()
    forward, backward = _forward_call(system), _backward_call(system)
    shapes = {
        "q_new": (1, system.nq),
        "v_new": (1, system.nv),
        "impulse": (1, system.nb, 6),
        "normal_impulse": (1, system.nb),
        "fault": (1,),
    }
    bar_shapes = {
        "q_bar": (1, system.nq),
        "v_bar": (1, system.nv),
        "ctrl_bar": (1, system.nu),
    }

    @jax.custom_vjp
    def run(q: jax.Array, v: jax.Array, control: jax.Array) -> tuple[jax.Array, ...]:
        outputs = forward(q[None], v[None], control[None], output_dims=shapes)
        return tuple(output[0] for output in outputs)

    def run_forward(q: jax.Array, v: jax.Array, control: jax.Array) -> Any:
        return run(q, v, control), (q, v, control)

    def run_backward(inputs: Any, bars: Any) -> tuple[jax.Array, ...]:
        # the fault is a flag and has no adjoint
        arrays = [x[None] for x in (*inputs, *bars[:-1])]
        outputs = backward(*arrays, output_dims=bar_shapes)
        return tuple(output[0] for output in outputs)

    run.defvjp(run_forward, run_backward)
    return run


@functools.cache
def _inspection(system: System, name: str) -> Any:
    """A kernel of ``kernels.inspect`` as a function of (worlds, nq) and (worlds, nv)."""
    real = SCALARS[system.dtype]
    inspect = kernels(system.dtype).inspect

    def launch(q: Any, **arrays: Any) -> None:
        views = _fill(inspect.Views(), q=q, **arrays)
        with _errors_contained():
            kernel = getattr(inspect, name)
            launcher(system, q.device).inspect(kernel, q.shape[0], views)

    def dynamics_forward(
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        mass_matrix: wp.array3d(dtype=real),
        bias: wp.array2d(dtype=real),
    ):
        launch(q, v=v, mass_matrix=mass_matrix, bias=bias)

    def kinematics_forward(
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        pose: wp.array3d(dtype=real),
        twist: wp.array3d(dtype=real),
    ):
        launch(q, v=v, pose=pose, twist=twist)

    def kinematics_backward(
        q: wp.array2d(dtype=real),
        v: wp.array2d(dtype=real),
        pose_bar: wp.array3d(dtype=real),
        twist_bar: wp.array3d(dtype=real),
        q_bar: wp.array2d(dtype=real),
        v_bar: wp.array2d(dtype=real),
    ):
        views = _fill(inspect.Views(), q=q, v=v)
        bars = _fill(inspect.Views(), q=q_bar, v=v_bar, pose=pose_bar, twist=twist_bar)
        with _errors_contained():
            kernel = inspect.kinematics_backward
            launcher(system, q.device).inspect(kernel, q.shape[0], views, bars)

    functions = (dynamics_forward, kinematics_forward, kinematics_backward)
    function = {f.__name__: f for f in functions}[name]
    return _callable(function, 2, inspect)


def dynamics(system: System, q: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mass matrix (nv, nv) and bias forces (nv,) of one world."""
    shapes = {"mass_matrix": (1, system.nv, system.nv), "bias": (1, system.nv)}
    outputs = _inspection(system, "dynamics_forward")(q[None], v[None], output_dims=shapes)
    return outputs[0][0], outputs[1][0]


@functools.cache
def kinematics(system: System) -> Any:
    """Differentiable poses (nb, 7) and twists (nb, 6) about O of one world."""
    shapes = {"pose": (1, system.nb, 7), "twist": (1, system.nb, 6)}
    bar_shapes = {"q_bar": (1, system.nq), "v_bar": (1, system.nv)}

    @jax.custom_vjp
    def run(q: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        call = _inspection(system, "kinematics_forward")
        pose, twist = call(q[None], v[None], output_dims=shapes)
        return pose[0], twist[0]

    def run_forward(q: jax.Array, v: jax.Array) -> Any:
        return run(q, v), (q, v)

    def run_backward(inputs: Any, bars: Any) -> tuple[jax.Array, ...]:
        call = _inspection(system, "kinematics_backward")
        arrays = [x[None] for x in (*inputs, *bars)]
        return tuple(bar[0] for bar in call(*arrays, output_dims=bar_shapes))

    run.defvjp(run_forward, run_backward)
    return run


interrupts.protect(FfiCallable.ffi_callback)


def to_jax(array: Any) -> jax.Array:
    """View a Warp array as a JAX array without a copy.

    The view is read-only by contract: later Warp writes to the memory show through.

    Args:
        array: Warp array; on a GPU the current Warp stream is finished first.

    Returns:
        The JAX array on the same device.
    """
    if array.device.is_cuda:
        wp.synchronize_stream(wp.get_stream(array.device))
    return wp.to_jax(array)


def from_jax(array: jax.Array, dtype: Any = None) -> Any:
    """View a JAX array as a Warp array without a copy.

    JAX arrays are immutable: never write to the view.

    Args:
        array: Concrete JAX array; waited for before it is shared.
        dtype: Warp dtype to reinterpret the last axes with, as ``wp.vec3``.

    Returns:
        The Warp array on the same device.

    Raises:
        TypeError: ``array`` is traced.
    """
    if isinstance(array, jax.core.Tracer):
        raise TypeError(
            "from_jax: array is traced; a DLPack view needs a concrete array"
        )
    return wp.from_jax(jax.block_until_ready(array), dtype=dtype)


