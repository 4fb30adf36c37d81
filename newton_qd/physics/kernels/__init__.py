"""Warp kernels of one control step, in one precision.

The package is a template: :func:`newton_qd.physics.precision.kernels` loads it once
per scalar type under a name of its own, so that float32 and float64 come from one
source. ``real`` is that type; the modules below import it and its vectors from here.

Rules that the adjoint needs (Warp 1.19): every intermediate is stored once per step;
a function that is marked ``stage`` is skipped when a caller is replayed, so its
results travel through the scratch arrays only; a loop may only add up terms, into
a variable of its own that is only stored afterwards.
"""

import warp as wp

# Set by the loader before this file runs; float32 when imported directly.
real = globals().get("real", wp.float32)

if real is wp.float64:
    vec3, quat, mat33, transform = wp.vec3d, wp.quatd, wp.mat33d, wp.transformd
else:
    vec3, quat, mat33, transform = wp.vec3f, wp.quatf, wp.mat33f, wp.transformf

_SYNC = """
#if defined(__CUDA_ARCH__)
__syncwarp();
#endif
"""


@wp.func_native(snippet=_SYNC, adj_snippet=_SYNC, replay_snippet="")
def sync(lane: int):
    """Wait for the other lanes of a warp; nothing on a CPU.

    Takes an argument because Warp (1.19) leaves out the adjoint of a function that has
    none: without it the reverse pass would run unsynchronised.
    """
    ...


def stage(function):
    """Declare a Warp function that stores its results and is never replayed."""
    stage_function = wp.func(function)
    stage_function.skip_replay = True
    return stage_function
