"""Warp kernels of one control step, in one precision, for packs of worlds.

The package is a template: :func:`newton_qd.physics.precision.kernels` loads it once
per scalar type and width under a name of its own, so that float32 and float64, CPU
and GPU come from one source; and once more where worlds bring physical parameters of
their own or a scene has boxes, so that those who have none pay nothing for them, not
even time to compile. A thread computes
``width`` worlds side by side: as the elements of one vector instruction on a CPU,
where they fill it, and one on a GPU, whose threads are such elements already. So
``real``, ``vec3`` and the other types below hold one value for each world of a pack;
what :mod:`.cpp` does with them it does with each world by itself, and a world's
result depends neither on its place in the pack nor on its neighbours.

Rules that the adjoint needs (Warp 1.19): every intermediate is stored once per step;
a function that is marked ``stage`` is skipped when a caller is replayed, so its
results travel through the scratch arrays only; a loop may only add up terms, into
a variable of its own that is only stored afterwards.
"""

import warp as wp

# Set by the loader before this file runs; these when imported directly.
scalar = globals().get("scalar", wp.float32)
width = globals().get("width", 1)
# Whether every world brings physical parameters of its own.
parametric = globals().get("parametric", False)
# Whether obstacles may be boxes.
boxes = globals().get("boxes", True)

# One value for each world of a pack.
real = wp.types.vector(length=width, dtype=scalar)
vec3 = wp.types.matrix(shape=(3, width), dtype=scalar)
quat = wp.types.matrix(shape=(4, width), dtype=scalar)
transform = wp.types.matrix(shape=(7, width), dtype=scalar)
mat33 = wp.types.matrix(shape=(9, width), dtype=scalar)

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
