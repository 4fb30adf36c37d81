"""The memory of the kernels: columns of scratch, and tables of the model.

**Scratch.** One block of memory holds the intermediates of a group of worlds. It is
made of lines. A line holds one number of every world of the group, side by side::

    line 0:  q[0] of world 0, of world 1, ... of world 31
    line 1:  q[1] of world 0, of world 1, ...

A vector of three numbers is three lines. On a CPU a group is a pack, and a line is a
register of it. On a GPU a group is 32 worlds, whose threads read a line at once:
neighbours touch neighbouring addresses, and a warp moves one line of 128 bytes.

An array of the scratch is a handle: where the memory of the pack begins, and how many
lines further the array and its adjoint begin. All handles of a pack have the same base,
so a thread keeps one address, and the rest of an address is one product and one sum of
small integers.

**Tables** of the model are shared by all worlds, and never change while a kernel runs.

As with Warp's arrays, a load adds to the element's adjoint, and a store hands it over
and clears it; a store is not repeated when a function is replayed. An adjoint by hand
reads and writes the adjoints of elements themselves.
"""

import warp as wp

from .. import mat33, real, scalar, sym33, transform, vec3, width
from .native import CPP, PRELUDE

# Worlds of a group: numbers of a line.
SIDE = width if width > 1 else 32


@wp.struct
class Reals:
    """An array of numbers in the scratch."""

    base: wp.uint64  # address of the pack's first number
    first: int  # line where the array begins
    adjoint: int  # line where its adjoint begins


@wp.struct
class Vectors:
    """An array of vectors in the scratch; fields as of ``Reals``."""

    base: wp.uint64
    first: int
    adjoint: int


@wp.struct
class Transforms:
    """An array of transforms in the scratch; fields as of ``Reals``."""

    base: wp.uint64
    first: int
    adjoint: int


@wp.struct
class Matrices:
    """An array of 3 x 3 matrices in the scratch; fields as of ``Reals``."""

    base: wp.uint64
    first: int
    adjoint: int


@wp.struct
class Symmetrics:
    """An array of symmetric 3 x 3 matrices in the scratch; fields as of ``Reals``."""

    base: wp.uint64
    first: int
    adjoint: int


@wp.struct
class IntTable:
    """A table of integers."""

    data: wp.uint64  # address


@wp.struct
class RealTable:
    """A table of numbers."""

    data: wp.uint64


@wp.struct
class VectorTable:
    """A table of vectors."""

    data: wp.uint64


@wp.struct
class TransformTable:
    """A table of transforms."""

    data: wp.uint64


@wp.struct
class MatrixTable:
    """A table of 3 x 3 matrices."""

    data: wp.uint64


# What an array of the scratch holds.
ARRAYS = {
    Reals: real,
    Vectors: vec3,
    Transforms: transform,
    Matrices: mat33,
    Symmetrics: sym33,
}
# What an entry of a table is in the caller's memory, and in a pack.
ENTRIES = {
    RealTable: (scalar, real),
    VectorTable: (wp.types.vector(length=3, dtype=scalar), vec3),
    TransformTable: (wp.types.transformation(dtype=scalar), transform),
    MatrixTable: (wp.types.matrix(shape=(3, 3), dtype=scalar), mat33),
}
# Numbers of an element of a scratch array.
COUNTS = {handle: CPP[kind][2] for handle, kind in ARRAYS.items()}

ADDRESS = """
#if defined(__CUDA_ARCH__)
#define GLOBAL(address) __cvta_global_to_generic(address)
#else
#define GLOBAL(address) (address)
#endif
"""


def _at(line: str, n: int) -> str:
    """C++: the element's type, and ``at``, where its first number is."""
    more = "" if line == "first" else f" + (a.{line} - a.first) * {SIDE}"
    return f"""{PRELUDE}{ADDRESS}
#if defined(__CUDA_ARCH__)
unsigned line = a.{line} + i * {n};
Number* at = (Number*)GLOBAL(a.base + (size_t)line * ({SIDE} * sizeof(Number)));
#else
Number* at = (Number*)a.base + (long long)i * {n * SIDE}{more};
#endif
"""


def _both(gpu: str, cpu: str) -> str:
    """C++ text of a loop over the numbers on a GPU, and of packs on a CPU."""
    return f"""
#if defined(__CUDA_ARCH__)
#pragma unroll
{gpu}
#else
{cpu}
#endif
"""


def _read(line: str, cpp: str, n: int) -> str:
    """C++ text that returns an element."""
    both = _both(
        f"for (int j = 0; j < {n}; ++j) ((Number*)&value)[j] = at[j * {SIDE}];",
        f"Convert::out(Convert::in(*({cpp}*)at), value);",
    )
    return f"{_at(line, n)}{cpp} value;{both}return value;"


def _write(line: str, cpp: str, n: int) -> str:
    """C++ text that writes an element."""
    return _at(line, n) + _both(
        f"for (int j = 0; j < {n}; ++j) at[j * {SIDE}] = ((const Number*)&value)[j];",
        f"Convert::out(Convert::in(value), *({cpp}*)at);",
    )


@wp.func_native(
    snippet=f"""{ADDRESS}
return *(const int*)GLOBAL(a.data + (size_t)(unsigned)i * sizeof(int));""",
    adj_snippet="",
)
def load(a: IntTable, i: int) -> int:
    """Element ``i`` of a table."""
    ...


for _handle, _type in ARRAYS.items():
    _name, _cpp, _n = CPP[_type]
    _EACH = f"for (int j = 0; j < {_n}; ++j)"

    # lanes that share a world may meet here
    _ADJ_LOAD = _at("adjoint", _n) + _both(
        f"{_EACH} atomicAdd(at + j * {SIDE}, ((const Number*)&adj_ret)[j]);",
        f"Convert::more(Convert::in(adj_ret), *({_cpp}*)at);",
    )
    _ADJ_STORE = _at("adjoint", _n) + _both(
        f"""{_EACH} {{
    ((Number*)&adj_value)[j] += at[j * {SIDE}];
    at[j * {SIDE}] = 0;
}}""",
        f"Convert::more(Convert::in(*({_cpp}*)at), adj_value); *({_cpp}*)at = {{}};",
    )
    _ADD = _at("adjoint", _n) + _both(
        f"{_EACH} at[j * {SIDE}] += ((const Number*)&value)[j];",
        f"Convert::more(Convert::in(value), *({_cpp}*)at);",
    )

    @wp.func_native(snippet=_read("first", _cpp, _n), adj_snippet=_ADJ_LOAD)
    def load(a: _handle, i: int) -> _type:
        """Element ``i`` of ``a``."""
        ...

    @wp.func_native(
        snippet=_write("first", _cpp, _n), adj_snippet=_ADJ_STORE, replay_snippet=""
    )
    def store(a: _handle, i: int, value: _type):
        """Write element ``i`` of ``a``."""
        ...

    @wp.func_native(snippet=_read("adjoint", _cpp, _n), adj_snippet="")
    def load_adjoint(a: _handle, i: int) -> _type:
        """Adjoint of element ``i`` of ``a``."""
        ...

    @wp.func_native(
        snippet=_write("adjoint", _cpp, _n), adj_snippet="", replay_snippet=""
    )
    def store_adjoint(a: _handle, i: int, value: _type):
        """Write the adjoint of element ``i`` of ``a``."""
        ...

    # without atomics: one lane owns the entry
    @wp.func_native(snippet=_ADD, adj_snippet="", replay_snippet="")
    def add_adjoint(a: _handle, i: int, value: _type):
        """Add to the adjoint of element ``i`` of ``a``."""
        ...


for _handle, (_entry, _type) in ENTRIES.items():
    _name, _cpp, _n = CPP[_type]
    _CONSTANT = f"""
{PRELUDE}{ADDRESS}
const Number* at = (const Number*)GLOBAL(
    a.data + (size_t)(unsigned)i * {_n} * sizeof(Number));
{_name} value;
for (int j = 0; j < {_n}; ++j)
#if defined(__CUDA_ARCH__)
    ((Real*)&value)[j] = __ldg(at + j);
#else
    ((Real*)&value)[j] = Real(at[j]);
#endif
return Convert::out(value);
"""

    @wp.func_native(snippet=_CONSTANT, adj_snippet="")
    def constant(a: _handle, i: int) -> _type:
        """Element ``i`` of a table without adjoint, the same for all worlds."""
        ...


@wp.func_native(
    snippet=f"""
{PRELUDE}
Real value;
#if defined(__CUDA_ARCH__)
value = a.data[i];
#else
for (int j = 0; j < {width}; ++j)
    value[j] = a.data[i + (j < count ? j : count - 1) * stride];
#endif
return Convert::out(value);""",
    adj_snippet="",
)
def read_input(a: wp.array[scalar], i: int, stride: int, count: int) -> real:
    """Element ``i`` of a row and of the next ``count - 1`` rows, one world each.

    Worlds of the pack beyond ``count`` repeat the last one. Without adjoint.
    """
    ...


@wp.func_native(
    snippet=f"""
{PRELUDE}
Real it = Convert::in(value);
#if defined(__CUDA_ARCH__)
if (count > 0) a.data[i] = it;
#else
for (int j = 0; j < {width}; ++j)
    if (j < count) a.data[i + j * stride] = it[j];
#endif
""",
    adj_snippet="",
    replay_snippet="",
)
def write_output(a: wp.array[scalar], i: int, stride: int, count: int, value: real):
    """Write element ``i`` of a row and of the next ``count - 1`` rows."""
    ...
