"""Finds misspelt names in a URDF file, which would silently mean nothing.

A URDF file may have elements and attributes of simulators, so a name that this package
does not know is no error. But one that is almost a known name is a slip.
"""

from __future__ import annotations

from collections.abc import Iterator
from xml.etree import ElementTree

from newton_qd.checks import Fact, message
from newton_qd.physics.model.xml_reader import XmlReader

_SHORT = 5  # letters; shorter names are misspelt by one slip, longer ones by up to two

_CHILDREN = {
    "link": ("inertial", "visual", "collision"),
    "joint": (
        "origin",
        "parent",
        "child",
        "axis",
        "limit",
        "dynamics",
        "mimic",
        "calibration",
        "safety_controller",
    ),
    "inertial": ("origin", "mass", "inertia"),
    "visual": ("origin", "geometry", "material"),
    "collision": ("origin", "geometry"),
    "geometry": ("box", "sphere", "cylinder", "capsule", "mesh"),
    "material": ("color", "texture"),
}
"""Elements inside each element."""

_ATTRIBUTES = {
    "link": ("name",),
    "joint": ("name", "type"),
    "visual": ("name",),
    "collision": ("name",),
    "material": ("name",),
    "origin": ("xyz", "rpy"),
    "mass": ("value",),
    "inertia": ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"),
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length", "height"),
    "mesh": ("filename", "scale"),
    "color": ("rgba",),
    "parent": ("link",),
    "child": ("link",),
    "axis": ("xyz",),
    "limit": ("lower", "upper", "effort", "velocity"),
    "dynamics": ("damping", "friction"),
}
"""Attributes of each element."""

_POSES = ("origin", "axis")
"""Elements in which an attribute of another form, such as ``quat``, would be lost."""


def misspelt(reader: XmlReader) -> tuple[str, ...]:
    """Returns a text about each name in links and joints that is almost a known one.

    Of a pose, each unknown attribute has a text, unless it has a prefix, such as
    ``drake:``.
    """
    return tuple(
        text
        for tag in ("link", "joint")
        for element in reader.root.findall(tag)
        for text in _inside(reader, element)
    )


def _inside(reader: XmlReader, element: ElementTree.Element) -> Iterator[str]:
    """Yields the texts about an element and those inside it."""
    known = _ATTRIBUTES.get(element.tag, ())
    for name in element.keys():
        unread = element.tag in _POSES and name not in known and ":" not in name
        if unread or _almost(name, known):
            yield str(_ignored(reader, element, "attribute", name, known))
    known = _CHILDREN.get(element.tag, ())
    for child in element:
        if child.tag in known:
            yield from _inside(reader, child)
        elif _almost(child.tag, known):
            tags = tuple(f"<{tag}>" for tag in known)
            yield str(_ignored(reader, child, "element", f"<{child.tag}>", tags))


def _almost(name: str, known: tuple[str, ...]) -> bool:
    """Returns whether a name is not known, but almost."""
    return name not in known and any(
        _slips(name.lower(), other) <= (1 if len(other) < _SHORT else 2)
        for other in known
    )


def _slips(name: str, other: str) -> int:
    """Returns how many letters are wrong, missing, too many or swapped.

    It is the optimal string alignment distance (Damerau 1964, "A technique for computer
    detection and correction of spelling errors").
    """
    rows = [list(range(len(other) + 1))]
    for i, a in enumerate(name, start=1):
        row = [i]
        for j, b in enumerate(other, start=1):
            cost = min(rows[-1][j] + 1, row[-1] + 1, rows[-1][j - 1] + (a != b))
            if i > 1 and j > 1 and (a, name[i - 2]) == (other[j - 2], b):
                cost = min(cost, rows[-2][j - 2] + 1)
            row.append(cost)
        rows.append(row)
    return rows[-1][-1]


def _ignored(
    reader: XmlReader,
    element: ElementTree.Element,
    kind: str,
    name: str,
    known: tuple[str, ...],
) -> Exception:
    why = "which is unknown, so it is ignored"
    return reader.error(element, message(kind, Fact(name), ", ".join(known), why=why))
