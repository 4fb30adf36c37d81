"""Refuses what a URDF file says and nobody reads: templates, and second elements."""

from __future__ import annotations

from newton_qd.checks import Fact
from newton_qd.physics.model.xml_reader import XmlReader

_ONCE = {
    "joint": ("origin", "parent", "child", "axis", "limit", "dynamics", "mimic"),
    "link/inertial": ("origin", "mass", "inertia"),
    "link/collision": ("origin", "geometry"),
}
"""Elements that must not stand twice inside those of a path."""


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
            allowed = "URDF; run xacro on the file first"
            raise reader.refused(element, "element", Fact(f"<{element.tag}>"), allowed)
    for path, tags in _ONCE.items():
        for element in reader.root.findall(path):  # not those of simulators
            for tag in tags:
                for second in element.findall(tag)[1:]:
                    raise reader.error(second, f"second <{tag}> of this {element.tag}")
