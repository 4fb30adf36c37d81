"""Kernels as JAX functions: a launch behind XLA's foreign function interface.

A kernel takes contiguous rows, one for each world. As a function of one world's row it
goes through ``jit``, ``vmap`` and ``grad``; a batch of any nesting is one launch.
"""

import contextlib
from collections.abc import Callable, Iterator
from typing import Protocol

import jax
import warp as wp

from newton_qd.physics import interrupts
from newton_qd.physics.precision import SCALARS
from newton_qd.physics.warp_internals import ffi_callback

interrupts.protect(ffi_callback())


@contextlib.contextmanager
def _errors_contained() -> Iterator[None]:
    """Turn what Warp would let through XLA's frames into an error that it reports.

    Raises:
        RuntimeError: Something else than an ``Exception`` was raised, such as an
            interrupt.
    """
    # notebooks put Python's own SIGINT handler back before every cell
    interrupts.install()
    try:
        yield
    except Exception:
        raise
    except BaseException as error:
        raise RuntimeError(f"interrupted inside the physics: {error!r}") from error


class RowCall(Protocol):
    """A kernel as a function of contiguous rows, one world's each."""

    def __call__(self, *rows: jax.Array, output_dims: int) -> tuple[jax.Array, ...]:
        """A tuple of one row of length ``output_dims``."""
        ...


Differentiable = Callable[[jax.Array], jax.Array]
"""Reverse-mode function of one world's row of inputs; returns its row of outputs."""


def row_call(
    name: str, dtype: str, module: wp.Module, launch: Callable[..., None]
) -> RowCall:
    """A launch as a function of contiguous rows.

    Args:
        name: Kernel; one that ends in ``_backward`` takes the adjoints of the outputs
            as a second argument.
        dtype: Type of the rows.
        module: Warp module of the kernel; Warp loads it when a call is traced.
        launch: Runs the kernel on Warp arrays of rows: the inputs, then the outputs.

    Returns:
        Function of one world's rows that returns a tuple of one row; its
        ``output_dims`` says how long. Under ``vmap`` the worlds share one launch.
    """
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
    # Warp numbers and keeps every call that it traces, and XLA compiles each number:
    # without jit that would be every eager call
    return jax.jit(call, static_argnames="output_dims", inline=True)


def differentiable(
    call: Callable[[str], RowCall], name: str, size: int, output_size: int
) -> Differentiable:
    """Reverse-mode function of one row; the adjoint is compiled when first traced.

    Args:
        call: Makes the function of a kernel, as :func:`row_call`, from its name.
        name: Kernels, without ``_forward`` and ``_backward``.
        size: Length of a row of inputs.
        output_size: Length of a row of outputs.
    """

    @jax.custom_vjp
    def run(x: jax.Array) -> jax.Array:
        return call(f"{name}_forward")(x, output_dims=output_size)[0]

    def run_forward(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        return run(x), x

    def run_backward(x: jax.Array, y_bar: jax.Array) -> tuple[jax.Array]:
        return (call(f"{name}_backward")(x, y_bar, output_dims=size)[0],)

    run.defvjp(run_forward, run_backward)
    return run
