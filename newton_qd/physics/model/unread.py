"""Refuses what a URDF file says and nobody reads: templates, and second elements."""

from __future__ import annotations

from newton_qd.checks import Fact
from newton_qd.physics.model.xml_reader import XmlReader

_ONCE = {
    "joint": ("origin", "parent", "child", "axis", "limit", "dynamics", "mimic"),
    "inertial": ("origin", "mass", "inertia"),
    "collision": ("origin", "geometry"),
}
"""Elements that must not stand twice inside each element."""


def refuse_unread(reader: XmlReader) -> None:
    """Checks that a file has no elements of xacro, and each element once.

    Args:
        reader: The file.

    Raises:
        RobotDescriptionError: An element is of xacro, which makes URDF files of
            templates, or it is the second one of its kind.
    """
    for element in reader.root.iter():
        if element.tag.startswith("xacro:"):
            given, allowed = (
                Fact(f"<{element.tag}>"),
                "URDF; run xacro on the file first",
            )
            raise reader.refused(element, "element", given, allowed)
        for tag in _ONCE.get(element.tag, ()):
            for second in element.findall(tag)[1:]:
                raise reader.error(second, f"second <{tag}> of this {element.tag}")
