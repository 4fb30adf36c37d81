"""Descriptors of whole episodes, computed by kernels."""

import functools

import jax
import jax.numpy as jnp
import warp as wp

from newton_qd.checks import Fact, listed, message
from newton_qd.physics import row_calls
from newton_qd.physics.native import Plan
from newton_qd.physics.precision import SCALARS, Variant, build_kernels
from newton_qd.physics.row_calls import (
    Differentiable,
    RowCall,
    differentiable,
    native_row_call,
    row_call,
)
from newton_qd.physics.warp_internals import cpu_entry


@functools.cache
def _episode_call(name: str, dtype: str, steps: int, nd: int) -> RowCall:
    """Wraps a kernel of ``kernels.episodes`` as a function of one episode's row."""
    kernel = getattr(build_kernels(Variant(dtype, 1)).episodes, name)
    device, size = row_calls.default_device(), steps * (nd + 1)
    kernel.module.load(device)
    if row_calls.native(device):
        written = nd if name.startswith("final") else steps * nd
        adjoint = name.endswith("_backward")
        rows = [size, written, size][: 3 if adjoint else 2]
        arrays = [wp.zeros(1, dtype=SCALARS[dtype], device=device) for _ in rows]
        inputs = [steps, nd, *arrays]
        recorded = wp.launch(
            kernel, dim=nd, inputs=inputs, device=device, record_cmd=True
        )
        assert isinstance(recorded, wp.Launch)  # because of record_cmd
        content = (name, dtype, steps, nd)
        entry = cpu_entry(recorded, adjoint=False)
        bytes_ = wp.types.type_size_in_bytes(SCALARS[dtype])
        return native_row_call(Plan(content, entry, rows, number_bytes=bytes_))

    def launch(x: wp.array, *arrays: wp.array) -> None:
        episodes = x.shape[0] // size
        inputs = [steps, nd, x, *arrays]
        wp.launch(kernel, dim=episodes * nd, inputs=inputs, device=x.device)

    return row_call(name, dtype, kernel.module, launch)


@functools.cache
def _episode_reduction(
    name: str, dtype: str, steps: int, nd: int, size: int
) -> Differentiable:
    """Returns a reverse-mode function of one episode's row.

    The mask has no gradient.
    """
    call = functools.partial(_episode_call, dtype=dtype, steps=steps, nd=nd)
    return differentiable(call, name, steps * (nd + 1), size)


def _episode_row(state_desc: jax.Array, mask: jax.Array) -> jax.Array:
    if state_desc.ndim != 2 or mask.shape != state_desc.shape[:1] or not mask.size:
        given = Fact(f"shapes {state_desc.shape}, {mask.shape}")
        allowed = "(t, nd) and (t,), t of 1 or more"
        raise ValueError(message("state_desc, mask", given, allowed))
    if state_desc.dtype.name not in SCALARS:
        raise TypeError(message("state_desc", state_desc, listed(SCALARS)))
    return jnp.concatenate([state_desc.ravel(), mask.astype(state_desc.dtype)])


def episode_proportion(state_desc: jax.Array, mask: jax.Array) -> jax.Array:
    """Averages the state descriptors over the valid steps of one episode.

    On a CPU the result is bitwise equal to
    :func:`newton_qd.extractors.get_feet_contact_proportion`. Under ``vmap`` all
    episodes share one launch.

    Args:
        state_desc: (t, nd) state descriptors before each step.
        mask: (t,) 1 for a step after the end of the episode, else 0.

    Returns:
        (nd,) proportions [-]. Differentiable in reverse mode with respect to
        ``state_desc``.

    Raises:
        TypeError: The kernels do not support the type of ``state_desc``.
        ValueError: ``state_desc`` or ``mask`` has the wrong shape, or has no steps.
    """
    row = _episode_row(state_desc, mask)
    steps, nd = state_desc.shape
    dtype, size = state_desc.dtype.name, steps * nd
    run = _episode_reduction("proportion", dtype, steps, nd, size)
    return run(row).reshape(nd, steps)[:, 0]


def episode_final(state_desc: jax.Array, mask: jax.Array) -> jax.Array:
    """Returns the state descriptor before the last valid step of one episode.

    On a CPU the result is bitwise equal to
    :func:`newton_qd.extractors.get_final_xy_position`. Under ``vmap`` all episodes
    share one launch.

    Args:
        state_desc: (t, nd) state descriptors before each step.
        mask: (t,) 1 for a step after the end of the episode, else 0.

    Returns:
        (nd,) descriptor. Differentiable in reverse mode with respect to
        ``state_desc``.

    Raises:
        TypeError: The kernels do not support the type of ``state_desc``.
        ValueError: ``state_desc`` or ``mask`` has the wrong shape, or has no steps.
    """
    row = _episode_row(state_desc, mask)
    steps, nd = state_desc.shape
    return _episode_reduction("final", state_desc.dtype.name, steps, nd, nd)(row)
