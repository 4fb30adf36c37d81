"""Reading and writing one element of a contiguous array.

Warp's own indexing multiplies by strides that it reads from memory, three times for
a three-dimensional array; the step spends most of its time there. These compile to
one instruction. As with Warp's, a load adds to the element's adjoint, and a store
hands it over and clears it; a store is not repeated when a function is replayed.
"""

import warp as wp

from . import mat33, real, transform, vec3

_LOAD = "return a.data[i];"
_ADJ_LOAD = """
#if defined(__CUDA_ARCH__)
wp::atomic_add(a.grad + i, adj_ret);
#else
a.grad[i] = wp::add(a.grad[i], adj_ret);
#endif
"""
_STORE = "a.data[i] = value;"
_ADJ_STORE = "adj_value = wp::add(adj_value, a.grad[i]); a.grad[i] = {};"


@wp.func_native(snippet=_LOAD, adj_snippet="")
def load(a: wp.array[int], i: int) -> int:
    """Element ``i`` of ``a``."""
    ...


@wp.func_native(snippet=_LOAD, adj_snippet="")
def constant(a: wp.array[real], i: int) -> real:
    """Element ``i`` of an array that has no adjoint."""
    ...


@wp.func_native(snippet=_LOAD, adj_snippet="")
def constant(a: wp.array[vec3], i: int) -> vec3:  # noqa: F811
    """Element ``i`` of an array that has no adjoint."""
    ...


@wp.func_native(snippet=_LOAD, adj_snippet="")
def constant(a: wp.array[mat33], i: int) -> mat33:  # noqa: F811
    """Element ``i`` of an array that has no adjoint."""
    ...


@wp.func_native(snippet=_LOAD, adj_snippet="")
def constant(a: wp.array[transform], i: int) -> transform:  # noqa: F811
    """Element ``i`` of an array that has no adjoint."""
    ...


@wp.func_native(snippet=_LOAD, adj_snippet=_ADJ_LOAD)
def load(a: wp.array[real], i: int) -> real:  # noqa: F811
    """Element ``i`` of ``a``."""
    ...


@wp.func_native(snippet=_LOAD, adj_snippet=_ADJ_LOAD)
def load(a: wp.array[vec3], i: int) -> vec3:  # noqa: F811
    """Element ``i`` of ``a``."""
    ...


@wp.func_native(snippet=_LOAD, adj_snippet=_ADJ_LOAD)
def load(a: wp.array[mat33], i: int) -> mat33:  # noqa: F811
    """Element ``i`` of ``a``."""
    ...


@wp.func_native(snippet=_LOAD, adj_snippet=_ADJ_LOAD)
def load(a: wp.array[transform], i: int) -> transform:  # noqa: F811
    """Element ``i`` of ``a``."""
    ...


@wp.func_native(snippet=_STORE, adj_snippet=_ADJ_STORE, replay_snippet="")
def store(a: wp.array[real], i: int, value: real):
    """Write element ``i`` of ``a``."""
    ...


@wp.func_native(snippet=_STORE, adj_snippet=_ADJ_STORE, replay_snippet="")
def store(a: wp.array[vec3], i: int, value: vec3):  # noqa: F811
    """Write element ``i`` of ``a``."""
    ...


@wp.func_native(snippet=_STORE, adj_snippet=_ADJ_STORE, replay_snippet="")
def store(a: wp.array[mat33], i: int, value: mat33):  # noqa: F811
    """Write element ``i`` of ``a``."""
    ...


@wp.func_native(snippet=_STORE, adj_snippet=_ADJ_STORE, replay_snippet="")
def store(a: wp.array[transform], i: int, value: transform):  # noqa: F811
    """Write element ``i`` of ``a``."""
    ...
