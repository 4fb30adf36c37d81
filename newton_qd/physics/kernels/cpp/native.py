"""Native functions on packs, written once in the terms of Warp's own C++ templates.

In the C++ text an argument ``a`` is ``A``, of type ``Real``, ``Vec3``, ``Quat``,
``Transform``, ``Mat33`` or ``Sym33``; the result is ``RET``; their adjoints are
``adj_A`` and ``adj_RET``. On a CPU ``Real`` is a vector of Clang's, on a GPU a number,
and all others but ``Sym33`` are Warp's ``vec_t<3, Real>`` and so on: Warp's functions
and their adjoints compute all worlds of a pack at once.
"""

import re

import warp as wp

from .. import mat33, quat, real, scalar, sym33, transform, vec3, width

_NUMBER = {wp.float32: "float", wp.float64: "double"}[scalar]
_ARGUMENT = re.compile(r"\b(?:adj_)?([A-Z]+)\b")

# Elements in memory are only as aligned as their numbers, hence Element beside Real.
TYPES = f"""
typedef {_NUMBER} Number;
#if defined(__CUDA_ARCH__)
typedef Number Real;
typedef Number Element;
#else
typedef Number Real __attribute__((ext_vector_type({width})));
typedef Number Element
    __attribute__((ext_vector_type({width}), aligned(sizeof(Number)), may_alias));
#endif
typedef wp::vec_t<3, Real> Vec3;
typedef wp::quat_t<Real> Quat;
typedef wp::transform_t<Real> Transform;
typedef wp::mat_t<3, 3, Real> Mat33;
struct Sym33 {{ Real xx, xy, xz, yy, yz, zz; }};
"""
# Warp type: its name in the C++ text, its C++ type, its elements
CPP = {real: ("Real", f"wp::vec_t<{width}, {_NUMBER}>", 1)} | {
    kind: (name, f"wp::mat_t<{n}, {width}, {_NUMBER}>", n)
    for kind, name, n in (
        (vec3, "Vec3", 3),
        (quat, "Quat", 4),
        (transform, "Transform", 7),
        (mat33, "Mat33", 9),
        (sym33, "Sym33", 6),
    )
}


def _conversion(name: str, cpp: str, n: int) -> str:
    return f"""
static CUDA_CALLABLE {name} in(const {cpp}& memory) {{
    {name} x;
    for (int i = 0; i < {n}; ++i) ((Real*)&x)[i] = ((const Element*)&memory)[i];
    return x;
}}
static CUDA_CALLABLE void out(const {name}& x, {cpp}& memory) {{
    for (int i = 0; i < {n}; ++i) ((Element*)&memory)[i] = ((const Real*)&x)[i];
}}
static CUDA_CALLABLE {cpp} out(const {name}& x) {{
    {cpp} memory;
    out(x, memory);
    return memory;
}}
static CUDA_CALLABLE void more(const {name}& x, {cpp}& memory) {{
    for (int i = 0; i < {n}; ++i) ((Element*)&memory)[i] += ((const Real*)&x)[i];
}}
static CUDA_CALLABLE {name} zero({name} x) {{
    for (int i = 0; i < {n}; ++i) ((Real*)&x)[i] = Real(0);
    return x;
}}"""


# Between packs in memory and the types above.
PRELUDE = (
    f"{TYPES}\nstruct Convert {{"
    + "".join(_conversion(*entry) for entry in CPP.values())
    + "\n};\n"
)
# Before C++ that computes element by element.
EACH = """
auto each = [](auto x, auto y, auto function) {
    for (int i = 0; i < sizeof(x) / sizeof(Real); ++i)
        ((Real*)&x)[i] = function(((Real*)&x)[i], ((Real*)&y)[i]);
    return x;
};
auto plus = [](Real x, Real y) { return x + y; };
auto minus = [](Real x, Real y) { return x - y; };
"""


def native(forward: str, adjoint: str = "", before: str = "") -> tuple[str, str]:
    """C++ texts of a function on packs and of its adjoint, for ``wp.func_native``.

    Args:
        forward: Expression of the result.
        adjoint: Statements that add to ``adj_A`` of every argument; may use ``RET``.
        before: Statements before both.
    """
    names = sorted({*_ARGUMENT.findall(f"{before}\n{forward}\n{adjoint}")} - {"RET"})
    values = "".join(f"auto {name} = Convert::in({name.lower()});\n" for name in names)
    start = f"{PRELUDE}{values}{before}\n"
    snippet = f"{start}return Convert::out({forward});"
    if not adjoint:
        return snippet, ""
    # added to memory at the end, one by one: two arguments may be one variable
    adjoints = "".join(f"decltype({n}) adj_{n} = Convert::zero({n});\n" for n in names)
    results = "".join(f"Convert::more(adj_{n}, adj_{n.lower()});\n" for n in names)
    result = f"auto RET = {forward};\n" if re.search(r"\bRET\b", adjoint) else ""
    return snippet, (
        f"{start}{result}{adjoints}auto adj_RET = Convert::in(adj_ret);\n"
        f"{adjoint}\n{results}"
    )
