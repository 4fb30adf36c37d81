"""Warp kernels of one control step, for packs of worlds.

A thread computes a *pack*: ``width`` worlds side by side. On a CPU they are the
elements of a vector instruction, and fill it; on a GPU a thread is such an element
already, and a pack is one world. ``real``, ``vec3`` and the other types below hold one
value for each world of the pack. Functions of :mod:`.cpp` compute all of them at once
and each by itself: a world's result depends neither on its place in the pack nor on its
neighbours.

**Where to read first.** :mod:`.simulate` has the order of the stages. They are in
:mod:`.kinematics`, :mod:`.contact` (with :mod:`.nearest`, :mod:`.box`, :mod:`.pair`),
:mod:`.inertia`, :mod:`.joints`, :mod:`.solve`, :mod:`.integration` and
:mod:`.readings`.
The solve is in :mod:`.articulation` and, for pairs, :mod:`.coupling`; its adjoint is by
hand, in :mod:`.multipliers` and :mod:`.parts`.
:mod:`.structs` declares what they read (``Model``), their intermediates (``Scratch``)
and where these begin (``Offsets``); :mod:`.rows` where the fields of a row of inputs or
outputs begin. :mod:`.world` moves these rows, with :mod:`.parameters` for parameters
of each world. :mod:`.forward` and :mod:`.backward` are the kernels of a step;
:mod:`.bodies`, :mod:`.bodies_backward`, :mod:`.dynamics` and :mod:`.gaps` show a system
from inside and share :mod:`.coordinates`; :mod:`.impulses` runs a whole step for that;
:mod:`.episodes` and :mod:`.conventions` do not use packs. :mod:`.cpp.memory` says how
the intermediates lie in memory.

**Variants.** The package is a template. Its files run once for each
:class:`~newton_qd.physics.precision.Variant`, as a package of its own name: float32 and
float64, CPU and GPU come from one source, and what a scene does not need is not
compiled. docs/physics.md says why the files run again.

**Rules.** Warp (1.19) makes the adjoint from the source, and does it correctly only if:

1. Every intermediate is stored once: a store's adjoint takes the element's adjoint and
   clears it. One substep has entries of its own where the adjoint runs (``keep``).
2. A function that stores is marked ``stage``, or has an adjoint by hand. Warp does not
   repeat a stage when it replays its caller. So a stage returns nothing: its results
   travel through the scratch arrays. What only a function with an adjoint by hand
   calls is marked ``plain``: Warp makes no adjoint of it, and rules 1 and 3 do not
   hold there.
3. A loop only adds terms to a variable, and nothing in the loop but its own sum reads
   that variable. Warp does not run a loop again before it walks back through what
   follows it.
4. No atomics and no ``+=`` on arrays: sums have a fixed order.
5. ``sync`` takes the lane: Warp leaves out the adjoint of a function without arguments.
6. Lanes share one pack: a store's index varies with the lane, or one lane stores.

Each function says what it reads and writes: ``sc`` is the scratch, ``g`` its adjoint,
``m`` the model. Arrays that its helpers reach are listed, those of stages are not.

``tests/kernel_lint.py`` checks these rules and lists on the syntax tree.
"""

import warp as wp

from newton_qd.physics.precision import variant_of
from newton_qd.physics.warp_internals import never_differentiate, never_replay

# What this copy of the package is for.
_variant = variant_of(__name__)
scalar = _variant.scalar
width = _variant.width
parametric = _variant.parametric
boxes = _variant.boxes
pairs = _variant.pairs
# Whether lanes share a pack: then what bodies need of themselves alone is computed
# ahead, side by side, and the sweeps over the tree only hand on.
shared = width == 1

# One value for each world of a pack.
real = wp.types.vector(length=width, dtype=scalar)
vec3 = wp.types.matrix(shape=(3, width), dtype=scalar)
quat = wp.types.matrix(shape=(4, width), dtype=scalar)
transform = wp.types.matrix(shape=(7, width), dtype=scalar)
mat33 = wp.types.matrix(shape=(9, width), dtype=scalar)
# xx, xy, xz, yy, yz, zz of a symmetric matrix
sym33 = wp.types.matrix(shape=(6, width), dtype=scalar)

# Threads of a GPU's block at most, and blocks that fit on a multiprocessor. They leave
# 128 registers for a thread of float32: few are spilled.
block = 256
bounds = (block, 1 if scalar == wp.float64 else 2)

_SYNC = """
#if defined(__CUDA_ARCH__)
__syncthreads();
#endif
"""


@wp.func_native(snippet=_SYNC, adj_snippet=_SYNC, replay_snippet="")
def sync(lane: int):
    """Wait for the other lanes, which are in one block; nothing on a CPU.

    Takes an argument because Warp (1.19) leaves out the adjoint of a function that has
    none: without it the reverse pass would run unsynchronised.
    """
    ...


def stage(function):
    """Declare a Warp function that stores its results and is never replayed."""
    return never_replay(wp.func(function))


def part(function):
    """Declare a part of a kernel that has an adjoint.

    On a CPU the kernel of the adjoint runs it first: a thread goes forward and back
    with a pack while the pack is in its caches. On a GPU a launch of the kernel itself
    runs it before, for all packs: then the kernel of the adjoint does not contain it.
    """
    return stage(function) if width == 1 else wp.func(function)


def plain(function):
    """Declare a Warp function that only functions with an adjoint by hand call.

    Warp makes no adjoint of it and does not replay it, so its loops and stores are
    those of any program. It may have an adjoint by hand itself.
    """
    return never_replay(never_differentiate(wp.func(function)))
