"""Finds angles in a URDF file that look like degrees. URDF has radians."""

from __future__ import annotations

import math
from xml.etree import ElementTree

from newton_qd.checks import Fact, message
from newton_qd.physics.model.xml_reader import XmlReader

_FRAMES = {
    "link": ("inertial/origin", "visual/origin", "collision/origin"),
    "joint": ("origin",),
}
"""Paths of the frames in links and joints."""

_ROLL = 2.0 * math.pi + 0.01  # largest angle that a file needs, with rounding [rad]
_TURNS = 4.0 * math.pi  # some joints turn twice [rad]


def in_degrees(reader: XmlReader) -> tuple[str, ...]:
    """Returns a text about each angle that looks like degrees.

    That is an angle of ``<origin>`` of more than a turn, or a limit of a hinge that is
    a whole number between two turns and 360.
    """
    texts = []
    for element in (*reader.root.findall("link"), *reader.root.findall("joint")):
        paths = _FRAMES[element.tag]
        for origin in (found for path in paths for found in element.iterfind(path)):
            if (abs(reader.numbers(origin, "rpy", 3, "0 0 0")) > _ROLL).any():
                texts.append(_degrees(reader, origin, "rpy"))
        if element.get("type") != "revolute":
            continue
        for limit in element.iterfind("limit"):
            texts += [
                _degrees(reader, limit, key)
                for key in ("lower", "upper")
                if limit.get(key) is not None
                and _TURNS < abs(value := float(limit.attrib[key])) <= 360.0
                and value.is_integer()
            ]
    return tuple(texts)


def _degrees(reader: XmlReader, element: ElementTree.Element, key: str) -> str:
    why = "which looks like degrees"
    text = message(key, Fact(element.attrib[key]), "radians, as it is read", why=why)
    return str(reader.error(element, text))
