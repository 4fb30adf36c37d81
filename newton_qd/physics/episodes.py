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


def _reduced(name: str, state_desc: jax.Array, mask: jax.Array) -> jax.Array:
    """Returns the row that a kernel writes for an episode.

    Raises:
        TypeError: The kernels do not support the type of ``state_desc``.
        ValueError: ``state_desc`` or ``mask`` has the wrong shape, or has no steps.
    """
    # numbers of NumPy may get another type here, and the kernel must be one of that
    state_desc, mask = jnp.asarray(state_desc), jnp.asarray(mask)
    shapes = state_desc.shape, mask.shape
    if state_desc.ndim != 2 or shapes[1] != shapes[0][:1] or not state_desc.size:
        given = Fact(f"shapes {shapes[0]}, {shapes[1]}")
        allowed = "(t, nd) and (t,), t and nd of 1 or more"
        raise ValueError(message("state_desc, mask", given, allowed))
    dtype, (steps, nd) = state_desc.dtype, state_desc.shape
    if dtype.name not in SCALARS:
        raise TypeError(message("state_desc", state_desc, listed(SCALARS)))
    size = nd if name == "final" else steps * nd
    run = _episode_reduction(name, dtype.name, steps, nd, size)
    return run(jnp.concatenate([state_desc.ravel(), mask.astype(dtype)]))


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
    row = _reduced("proportion", state_desc, mask)
    return row.reshape(jnp.shape(state_desc)[::-1])[:, 0]


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
    return _reduced("final", state_desc, mask)
