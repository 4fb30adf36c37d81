"""The interface between JAX and Warp.

Traced code calls the kernels through the wrappers of
:mod:`newton_qd.physics.row_calls`. Eager code shares memory through DLPack. Only this
module, ``episodes`` and ``row_calls`` use both libraries.
"""

import functools
from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np
import warp as wp
from jax.core import Tracer

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.physics import layout, row_calls
from newton_qd.physics.explicit_mesh import split_as, split_row
from newton_qd.physics.launch import Launcher, thread_count
from newton_qd.physics.layout import Layout
from newton_qd.physics.reverse_mode import without_derivative
from newton_qd.physics.row_calls import (
    RowCall,
    differentiable,
    native_row_call,
    row_call,
)
from newton_qd.physics.system import Kinematics, PhysicsState, System


@functools.cache
def _launcher(system: System, alias: str, parametric: bool) -> Launcher:
    return Launcher(system, wp.get_device(alias), parametric)


def launcher(system: System, device: wp.Device, parametric: bool = False) -> Launcher:
    """Returns the launcher of ``system`` on a Warp device. It is created once."""
    return _launcher(system, device.alias, parametric)


@functools.cache
def _kernel_call(
    system: System, name: str, size: int, parametric: bool = False
) -> RowCall:
    """Wraps a kernel of a system as a function of rows.

    Args:
        system: The system.
        name: Name of the kernel. If it ends in ``_backward``, the adjoint runs.
        size: Length of a row of inputs.
        parametric: Whether that row ends with the world's parameters.
    """
    default = launcher(system, row_calls.default_device(), parametric)
    if row_calls.native(default.device):
        return native_row_call(default.plan(name))

    def launch(x: wp.array, *arrays: wp.array) -> None:
        worlds, adjoint = x.shape[0] // size, name.endswith("_backward")
        assert x.device is not None
        own = launcher(system, x.device, parametric)
        own.launch(name, worlds, x, *arrays, adjoint=adjoint)

    return row_call(name, system.dtype, default.prepare(name), launch)


def _row(
    system: System, shapes: dict[str, tuple[int, ...]], **arrays: jax.Array
) -> jax.Array:
    """Concatenates the inputs of one world into a row.

    It checks every shape, because an input of the wrong size would shift the next ones.

    Args:
        system: The system.
        shapes: Shape of each input.
        **arrays: The inputs, in the order of the row.

    Raises:
        TypeError: The type of an array is not that of the system.
        ValueError: An array has the wrong shape, or the system is float64 and JAX x64
            is off.
    """
    checks.x64(np.dtype(system.dtype))  # else JAX would round the row to float32
    for name, array in arrays.items():
        allowed = f"an array of shape {shapes[name]}, {system.dtype}"
        if array.shape != shapes[name]:
            raise ValueError(message(name, array, allowed))
        if array.dtype != system.dtype:
            raise TypeError(message(name, array, allowed))
    inputs = list(arrays.values())
    return jnp.concatenate(split_as(inputs, inputs))


def _split(row: jax.Array, fields: Layout) -> dict[str, jax.Array]:
    """Splits one world's row (size,) into its fields, each in its shape."""
    parts = split_row(row, [field.offset for field in fields][1:])
    pairs = zip(fields, parts, strict=True)
    return {field.name: part.reshape(field.shape) for field, part in pairs}


class Step(Protocol):
    """The control step of one world, as :func:`control_step` returns it."""

    def __call__(
        self,
        q: jax.Array,
        v: jax.Array,
        control: jax.Array,
        params: jax.Array | None = None,
    ) -> tuple[PhysicsState, jax.Array]:
        """Returns the next state and the fault ().

        Raises:
            TypeError: The type of an array is not that of the system.
            ValueError: An array has the wrong shape, the value of
                ``NEWTON_QD_THREADS`` is not allowed, or the system is float64 and JAX
                x64 is off.
        """
        ...


def _outputs(system: System, row: jax.Array) -> tuple[PhysicsState, jax.Array]:
    """Splits the outputs of a step into the state and the fault ()."""
    found = _split(row, layout.outputs(system))
    fault = found.pop("fault")
    bodies = None
    if system.reports_bodies:
        seen = [field.name for field in layout.bodies(system)]
        bodies = Kinematics(**{name: found.pop(name) for name in seen})
    return PhysicsState(**found, bodies=bodies), fault


@functools.cache
def control_step(system: System) -> Step:
    """Returns the differentiable control step of one world.

    Args:
        system: The system.

    Returns:
        A function of ``q`` (nq,), ``v`` (nv,), ``control`` (nu,) and ``params``, the
        row (n,) of :func:`~newton_qd.physics.parameters.parameter_row`. It returns the
        next state and the fault (). ``params`` is optional: without it the world has
        the parameters of the system. The function supports first derivatives in reverse
        mode, but neither second derivatives nor forward mode. Under ``vmap`` all
        worlds share one launch.
    """
    read, written = layout.inputs(system), layout.outputs(system)
    count = layout.parameters(system).size
    shapes = read.shapes | {"params": (count,)}
    call = functools.partial(_kernel_call, system, size=read.size)
    step = differentiable(call, "step", read.size, written.size)
    size = layout.inputs(system, parametric=True).size
    call = functools.partial(_kernel_call, system, size=size, parametric=True)
    own_step = differentiable(call, "step", size, written.size)

    def run(
        q: jax.Array, v: jax.Array, control: jax.Array, params: jax.Array | None = None
    ) -> tuple[PhysicsState, jax.Array]:
        thread_count()  # raises for a wrong setting now, not inside a compiled call
        if params is None:
            y = step(_row(system, shapes, q=q, v=v, control=control))
        else:
            row = _row(system, shapes, q=q, v=v, control=control, params=params)
            y = own_step(row)
        return _outputs(system, y)

    return run


@functools.cache
def _rollout_call(system: System, name: str, parametric: bool) -> RowCall:
    plan = launcher(system, row_calls.default_device(), parametric).plan(name)
    return native_row_call(plan, "newton_qd_rollout")


def rollout(
    system: System,
    q: jax.Array,
    v: jax.Array,
    controls: jax.Array,
    params: jax.Array | None = None,
) -> tuple[PhysicsState, jax.Array]:
    """Advances one world by a plan of controls.

    On a CPU this is one call of XLA for all steps, and its adjoint is another one. On a
    GPU it is a scan over control steps.

    Args:
        system: The system.
        q: (nq,) coordinates [m or rad].
        v: (nv,) velocities [m/s or rad/s].
        controls: (T, nu) controls [-].
        params: Parameters of the world, as in :func:`control_step`.

    Returns:
        The states after each step, leaves (T, ...), and the faults (T,). A world with a
        fault keeps its state in all later steps, and has a fault in each.

    Raises:
        TypeError: The type of an array is not that of the system.
        ValueError: An array has the wrong shape, the value of ``NEWTON_QD_THREADS`` is
            not allowed, or the system is float64 and JAX x64 is off.
    """
    if controls.ndim != 2 or controls.shape[1] != system.nu:
        allowed = f"an array of shape (steps, {system.nu}), {system.dtype}"
        raise ValueError(message("controls", controls, allowed))
    # without controls, the rows do not say how many steps there are
    if not system.nu or not row_calls.native(row_calls.default_device()):
        return _scanned(system, q, v, controls, params)
    thread_count()  # raises for a wrong setting now, not inside a compiled call
    steps, parametric = len(controls), params is not None
    own = {"params": params} if params is not None else {}
    shapes = {
        **layout.coordinates(system).shapes,
        "params": (layout.parameters(system).size,),
        "controls": (controls.size,),
    }
    row = _row(system, shapes, q=q, v=v, **own, controls=controls.reshape(-1))
    written = layout.outputs(system).size
    run = differentiable(
        functools.partial(_rollout_call, system, parametric=parametric),
        "step",
        row.size,
        steps * written,
        keeps_outputs=True,
    )
    rows = run(row).reshape(steps, written)
    return jax.vmap(functools.partial(_outputs, system))(rows)


def _scanned(
    system: System,
    q: jax.Array,
    v: jax.Array,
    controls: jax.Array,
    params: jax.Array | None,
) -> tuple[PhysicsState, jax.Array]:
    """Does what :func:`rollout` does, step by step."""
    step = control_step(system)

    def advance(
        carry: tuple[jax.Array, jax.Array, jax.Array], control: jax.Array
    ) -> tuple[tuple, tuple]:
        q, v, faulty = carry
        control = jnp.where(faulty, jnp.nan, control)
        after, fault = step(q, v, control, params)
        return (after.q, after.v, faulty | (fault > 0)), (after, fault)

    sound = split_as([q], jnp.zeros((), bool))
    return jax.lax.scan(advance, (q, v, sound), controls)[1]


@functools.cache
def kinematics(system: System) -> Callable[[jax.Array, jax.Array], Kinematics]:
    """Returns the differentiable kinematics of one world as a function.

    Its arguments are ``q`` (nq,) and ``v`` (nv,). It raises TypeError if the type of an
    array is not that of the system, and ValueError if an array has the wrong shape, or
    if the system is float64 and JAX x64 is off.
    """
    read, written = layout.coordinates(system), layout.bodies(system)
    call = functools.partial(_kernel_call, system, size=read.size)
    views = differentiable(call, "bodies", read.size, written.size)

    def run(q: jax.Array, v: jax.Array) -> Kinematics:
        row = _row(system, read.shapes, q=q, v=v)
        return Kinematics(**_split(views(row), written))

    return run


def dynamics(system: System, q: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the mass matrix (nv, nv) and the bias forces (nv,) of one world.

    Raises:
        TypeError: The type of ``q`` or ``v`` is not that of the system.
        ValueError: ``q`` or ``v`` has the wrong shape, or the system is float64 and
            JAX x64 is off.
    """
    read, written = layout.coordinates(system), layout.dynamics(system)
    call = _kernel_call(system, "dynamics_forward", read.size)
    row = _row(system, read.shapes, q=q, v=v)
    row = without_derivative("physics.mass_matrix or bias_forces", row)
    found = _split(call(row, output_dims=written.size)[0], written)
    return found["mass_matrix"], found["bias"]


def contact_gaps(system: System, q: jax.Array) -> jax.Array:
    """Returns the contact gaps (nc,) of one world [m].

    Raises:
        TypeError: The type of ``q`` is not that of the system.
        ValueError: ``q`` has the wrong shape, or the system is float64 and JAX x64 is
            off.
    """
    read, written = layout.coordinates(system), layout.gaps(system)
    call = _kernel_call(system, "contact_gaps", read.size)
    row = _row(system, read.shapes, q=q, v=jnp.zeros((system.nv,), q.dtype))
    row = without_derivative("physics.contact_gaps", row)
    return call(row, output_dims=written.size)[0]


def contact_impulses(
    system: System, q: jax.Array, v: jax.Array, control: jax.Array
) -> jax.Array:
    """Returns the contact impulses (substeps, nc, 4) of a control step [N s].

    The last column is the normal part.

    Raises:
        TypeError: The type of an array is not that of the system.
        ValueError: An array has the wrong shape, or the system is float64 and JAX x64
            is off.
    """
    read, written = layout.inputs(system), layout.impulses(system)
    call = _kernel_call(system, "contact_impulses", read.size)
    row = _row(system, read.shapes, q=q, v=v, control=control)
    row = without_derivative("physics.contact_impulses", row)
    return _split(call(row, output_dims=written.size)[0], written)["impulse"]


def to_jax(array: wp.array) -> jax.Array:
    """Views a Warp array as a JAX array without a copy.

    The view must not be written to. It shows what Warp writes to the memory later.

    Args:
        array: Warp array. On a GPU the function first waits for the current Warp
            stream.

    Returns:
        The JAX array on the same device.
    """
    if array.device.is_cuda:
        wp.synchronize_stream(wp.get_stream(array.device))
    return wp.to_jax(array)


def from_jax(array: jax.Array, dtype: type | None = None) -> wp.array:
    """Views a JAX array as a Warp array without a copy.

    JAX arrays are immutable: never write to the view.

    Args:
        array: Concrete JAX array. The function waits until it is computed.
        dtype: Warp dtype for the last axes, for example ``wp.vec3``.

    Returns:
        The Warp array on the same device.

    Raises:
        TypeError: ``array`` is traced.
    """
    if isinstance(array, Tracer):
        allowed = "a concrete array, which a DLPack view needs"
        raise TypeError(message("from_jax: array", Fact("a traced one"), allowed))
    return wp.from_jax(jax.block_until_ready(array), dtype=dtype)
