"""Where the scratch of a pack is."""

import warp as wp

from ..structs import Scratch
from .memory import ARRAYS, SIDE
from .native import PRELUDE

_BASES = "\n".join(
    f"sc.{name}.base = base + ARRAY(sc.{name});"
    for name, field in Scratch.vars.items()
    if field.type in ARRAYS
)
_PLACE = f"""{PRELUDE}
#if defined(__CUDA_ARCH__)
#define ARRAY(handle) 0
#else
#define ARRAY(handle) handle.first * {SIDE} * sizeof(Number)
#endif
size_t group = column / {SIDE};
size_t number = group * sc.lines * {SIDE} + column % {SIDE};
auto base = (decltype(sc.q.base))sc.memory.data + number * sizeof(Number);
{_BASES}
return sc;
"""


@wp.func_native(snippet=_PLACE, adj_snippet="")
def place(sc: Scratch, column: int):
    """The scratch of a pack: its arrays begin in the pack's column of the memory."""
    return sc  # tells Warp the type of the result
