"""Reading and writing one element of a contiguous array.

Warp's own indexing multiplies by strides that it reads from memory, three times for
a three-dimensional array; the step would spend most of its time there. These compile
to one address. As with Warp's, a load adds to the element's adjoint, and a store
hands it over and clears it; a store is not repeated when a function is replayed.
An adjoint by hand reads and writes the adjoints of elements themselves.
"""

import warp as wp

from .. import mat33, real, scalar, sym33, transform, vec3, width
from .native import CPP, PRELUDE

_LOAD = PRELUDE + "return Convert::out(Convert::in(a.data[i]));"
_ADJ_LOAD = f"""
#if defined(__CUDA_ARCH__)
wp::atomic_add(a.grad + i, adj_ret);
#else
{PRELUDE}
Convert::more(Convert::in(adj_ret), a.grad[i]);
#endif
"""
_STORE = PRELUDE + "Convert::out(Convert::in(value), a.data[i]);"
_ADJ_STORE = (
    PRELUDE + "Convert::more(Convert::in(a.grad[i]), adj_value); a.grad[i] = {};"
)


@wp.func_native(snippet="return a.data[i];", adj_snippet="")
def load(a: wp.array[int], i: int) -> int:
    """Element ``i`` of ``a``."""
    ...


for _type in (real, vec3, transform, mat33, sym33):

    @wp.func_native(snippet=_LOAD, adj_snippet=_ADJ_LOAD)
    def load(a: wp.array[_type], i: int) -> _type:
        """Element ``i`` of ``a``."""
        ...

    @wp.func_native(snippet=_STORE, adj_snippet=_ADJ_STORE, replay_snippet="")
    def store(a: wp.array[_type], i: int, value: _type):
        """Write element ``i`` of ``a``."""
        ...

    @wp.func_native(
        snippet=PRELUDE + "return Convert::out(Convert::in(a.grad[i]));",
        adj_snippet="",
    )
    def load_adjoint(a: wp.array[_type], i: int) -> _type:
        """Adjoint of element ``i`` of ``a``."""
        ...

    @wp.func_native(
        snippet=PRELUDE + "Convert::out(Convert::in(value), a.grad[i]);",
        adj_snippet="",
        replay_snippet="",
    )
    def store_adjoint(a: wp.array[_type], i: int, value: _type):
        """Write the adjoint of element ``i`` of ``a``."""
        ...

    # without atomics: one lane owns the entry
    @wp.func_native(
        snippet=PRELUDE + "Convert::more(Convert::in(value), a.grad[i]);",
        adj_snippet="",
        replay_snippet="",
    )
    def add_adjoint(a: wp.array[_type], i: int, value: _type):
        """Add to the adjoint of element ``i`` of ``a``."""
        ...


# Entries of a table that all worlds share, and what they are in a pack.
TABLES = {
    real: scalar,
    vec3: wp.types.vector(length=3, dtype=scalar),
    mat33: wp.types.matrix(shape=(3, 3), dtype=scalar),
    transform: wp.types.transformation(dtype=scalar),
}

for _type, _entry in TABLES.items():
    _CONSTANT = f"""
{PRELUDE}
{CPP[_type][0]} value;
for (int j = 0; j < sizeof(value) / sizeof(Real); ++j)
    ((Real*)&value)[j] = Real(((const Number*)&a.data[i])[j]);
return Convert::out(value);
"""

    @wp.func_native(snippet=_CONSTANT, adj_snippet="")
    def constant(a: wp.array[_entry], i: int) -> _type:
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
a.data[i] = it;
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
