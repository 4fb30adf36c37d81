"""The only C++ of the kernels: arithmetic on packs of worlds, and access to memory.

Everything else in the kernels is Python that Warp compiles. These files are generated
C++ for one reason: speed on a CPU. They give 5.5 times the speed of a step, about 5
times with its gradient (docs/physics.md).

**What Warp cannot do.** Warp runs a CPU kernel one thread after the other, and Clang
does not merge the threads into vector instructions. Warp's vectors do not help either:
their elements are computed in loops, and most of its functions (``dot``,
``quat_rotate``) take vectors of numbers, not vectors of vectors. Its arrays compute an
address from strides in memory at every access.

**What is done instead.** One thread computes a pack: 8 worlds in float32, 4 in
float64, and one on a GPU. A number in a kernel is one number for each world of the
pack. In C++ it is ``Real``, a vector of Clang's that fills one register. Warp's C++
templates accept ``Real`` as their scalar: ``wp::vec_t<3, Real>`` is one vector for each
world, and ``wp::dot`` of two of them is 5 vector instructions. Their adjoints come with
them. Warp's Python does not know ``Real``. There, a number is a Warp vector of length
``width``, and a 3-D vector is a matrix (3, width), with the same bytes in memory.

**The files.**

- :mod:`.native` declares the C++ types and turns a C++ expression and its adjoint into
  a function for ``wp.func_native``.
- :mod:`.memory` reads and writes elements of arrays without strides.
- :mod:`.operators` has sums, differences, products and quotients. Where a file imports
  ``add``, ``sub``, ``mul``, ``div`` or ``neg``, Warp calls them for the operators.
  Python itself never does, so their import looks unused.
- :mod:`.algebra` has the rest of vectors, matrices, quaternions and transforms.
- :mod:`.numbers` has functions of one number: roots, clamps, choices.
- :mod:`.smooth` has the smooth one-sided functions and those of rotations.

**A new function** is its expression, and the statements of its adjoint. An argument
``a`` is ``A`` in C++, the result is ``RET``, and their adjoints are ``adj_A`` and
``adj_RET``::

    @wp.func_native(*native("A * B", "adj_A += B * adj_RET; adj_B += A * adj_RET;"))
    def mul(a: real, b: real) -> real:
        \"\"\"Product.\"\"\"
        ...

Rules for the adjoint:

1. ``adj_A`` is zero at first, and the adjoint adds this function's share to it. The
   shares of all arguments go to memory at the end, one after the other: two arguments
   may be the same variable.
2. ``RET`` is there where the text uses it; it is computed again.
3. It does not branch on one world: a comparison of packs chooses element by element
   (``A < B ? x : y``). A world's result depends on no other world of its pack.
4. No adjoint means that no gradient passes: for indices, comparisons and constants.
5. A load adds to the adjoint of an element. A store hands that adjoint on and clears
   it, and is skipped when Warp replays a function. So an element is stored once.

``tests/test_algebra.py`` compares every adjoint here with central differences, also
with one variable as both arguments, and finds a new function by itself.
"""
