"""Wraps kernels as JAX functions, through XLA's foreign function interface.

A kernel takes contiguous rows, one for each world. The wrapped function takes the row
of one world and supports ``jit``, ``vmap`` and ``grad``. A batch is one launch, also
with nested ``vmap``.
"""

import contextlib
import functools
from collections.abc import Callable, Iterator
from typing import Protocol

import jax
import numpy as np
import warp as wp

from newton_qd.checks import message
from newton_qd.physics import interrupts
from newton_qd.physics.ending import stop_at_exit
from newton_qd.physics.explicit_mesh import over_devices, row_like
from newton_qd.physics.native import Plan
from newton_qd.physics.native.library import library
from newton_qd.physics.precision import SCALARS
from newton_qd.physics.reverse_mode import (
    first_derivatives_only,
    reverse_mode_only,
)
from newton_qd.physics.warp_internals import ffi_callback

interrupts.protect(ffi_callback())


def default_device() -> wp.Device:
    """Returns the Warp device of the first JAX device."""
    device = wp.device_from_jax(jax.devices()[0])
    assert device is not None  # Warp finds it by the platform and index in JAX
    return device


def native(device: wp.Device) -> bool:
    """Returns whether XLA calls the kernels of a device without Python."""
    return device.is_cpu


class _Callbacks:
    """The calls from XLA into Python.

    Attributes:
        ended: Whether calls end with an error, because Python ends.
        refused: Number of calls that ended with this error.
    """

    ended: bool = False
    refused: int = 0

    @classmethod
    def end(cls) -> None:
        """Ends the programs of other threads at their next call."""
        cls.ended = True


@contextlib.contextmanager
def _errors_contained() -> Iterator[None]:
    """Convert exceptions that Warp does not catch into an error that Warp reports.

    Warp catches ``Exception`` in a callback. Any other exception would enter XLA's
    frames.

    Raises:
        RuntimeError: An exception that is not an ``Exception`` was raised, for example
            an interrupt; or Python ends.
    """
    # Notebooks restore Python's SIGINT handler before each cell.
    interrupts.install()
    if _Callbacks.ended:
        _Callbacks.refused += 1
        raise RuntimeError("the physics was stopped, because Python ends")
    try:
        yield
    except Exception:
        raise
    except BaseException as error:
        raise RuntimeError(f"interrupted inside the physics: {error!r}") from error


class RowCall(Protocol):
    """A kernel as a function of contiguous rows, one row for each world."""

    def __call__(self, *rows: jax.Array, output_dims: int) -> tuple[jax.Array, ...]:
        """Returns a tuple with one row of length ``output_dims``."""
        ...


Differentiable = Callable[[jax.Array], jax.Array]
"""Reverse-mode function from one world's row of inputs to its row of outputs."""


def row_call(
    name: str, dtype: str, module: wp.Module, launch: Callable[..., None]
) -> RowCall:
    """Wraps a launch as a function of contiguous rows.

    Args:
        name: Name of the kernel. If it ends in ``_backward``, the function takes the
            adjoints of the outputs as a second argument.
        dtype: Type of the rows.
        module: Warp module of the kernel. Warp loads it when a call is traced.
        launch: Runs the kernel on Warp arrays of rows: the inputs, then the outputs.

    Returns:
        Function of one world's rows. It returns a tuple with one row. The keyword
        argument ``output_dims`` is the length of that row. Under ``vmap`` the worlds
        share one launch.
    """
    interrupts.install()
    _end_callbacks()
    real = SCALARS[dtype]

    def forward(x: wp.array(dtype=real), y: wp.array(dtype=real)):
        with _errors_contained():
            launch(x, y)

    def backward(
        x: wp.array(dtype=real),
        y_bar: wp.array(dtype=real),
        x_bar: wp.array(dtype=real),
    ):
        with _errors_contained():
            launch(x, y_bar, x_bar)

    function = backward if name.endswith("_backward") else forward
    function.__name__ = function.__qualname__ = name
    function.__module__ = module.name
    call = wp.jax_callable(
        function,
        num_outputs=1,
        vmap_method="broadcast_all",
        graph_mode=wp.JaxCallableGraphMode.NONE,
    )
    jax.ffi.register_ffi_target_as_batch_partitionable(call.name)
    # Warp gives each traced call a number and keeps it, and XLA compiles each number.
    # jit traces once. Without jit, every eager call would be traced and compiled.
    traced = jax.jit(call, static_argnames="output_dims", inline=True)
    return over_devices(traced)


@functools.cache
def _register() -> None:
    """Tells XLA the native functions, and ends them before Python ends."""
    for name, address in library().handlers.items():
        capsule = jax.ffi.pycapsule(address)
        jax.ffi.register_ffi_target(name, capsule, platform="cpu")
        jax.ffi.register_ffi_target_as_batch_partitionable(name)
    stop_at_exit(library().stop, library().stopped, in_python=False)


@functools.cache
def _end_callbacks() -> None:
    """Ends calls into Python before Python ends."""
    stop_at_exit(_Callbacks.end, lambda: _Callbacks.refused, in_python=True)


def native_row_call(plan: Plan, target: str = "newton_qd_rows") -> RowCall:
    """Wraps a kernel of a CPU as a function of contiguous rows. It needs no Python.

    Args:
        plan: The kernel.
        target: Native function: ``"newton_qd_rows"`` runs the kernel once,
            ``"newton_qd_rollout"`` once for each step of a plan of controls.

    Returns:
        Function as :func:`row_call` returns it.
    """
    _register()
    plan.register()

    def call(*rows: jax.Array, output_dims: int) -> tuple[jax.Array, ...]:
        for given in rows:
            if given.dtype.itemsize != plan.number_bytes:  # it would read other memory
                allowed = f"numbers of {plan.number_bytes} bytes"
                raise TypeError(message("row of a kernel", given, allowed))
        row = row_like(rows, output_dims)
        run = jax.ffi.ffi_call(target, row, vmap_method="broadcast_all")
        return (run(*rows, plan=np.int64(plan.key)),)

    traced = jax.jit(call, static_argnames="output_dims", inline=True)
    return over_devices(traced)


def differentiable(
    call: Callable[[str], RowCall],
    name: str,
    size: int,
    output_size: int,
    *,
    keeps_outputs: bool = False,
) -> Differentiable:
    """Returns a reverse-mode function of one row.

    The adjoint kernel is compiled when a gradient is traced for the first time.

    Args:
        call: Returns the function of a kernel for its name, as :func:`row_call` does.
        name: Name of the kernels without ``_forward`` and ``_backward``.
        size: Length of a row of inputs.
        output_size: Length of a row of outputs.
        keeps_outputs: Whether the adjoint kernel takes the outputs too.
    """

    @jax.custom_vjp
    def run(x: jax.Array) -> jax.Array:
        return call(f"{name}_forward")(x, output_dims=output_size)[0]

    def run_forward(x: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        y = run(x)
        return y, (x, y) if keeps_outputs else (x,)

    def run_backward(kept: tuple[jax.Array, ...], y_bar: jax.Array) -> tuple[jax.Array]:
        adjoint = call(f"{name}_backward")
        run_adjoint = first_derivatives_only(
            lambda *rows: adjoint(*rows, output_dims=size)[0]
        )
        return (run_adjoint(*kept, y_bar),)

    run.defvjp(run_forward, run_backward)
    return lambda x: run(reverse_mode_only(x))
