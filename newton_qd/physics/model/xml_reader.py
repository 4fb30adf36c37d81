"""Reads attributes of an XML file. Each error names file, line and element."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree
from xml.parsers import expat

import numpy as np

from newton_qd.checks import message
from newton_qd.physics.reference import rpy_quaternion

LARGEST = 1e9
"""Largest number of a file, in SI units. The square of a larger one may overflow."""

IDENTITY = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
IDENTITY.setflags(write=False)


class RobotDescriptionError(ValueError):
    """The physics does not support a robot's URDF file or its ``RobotSpec``."""


class RobotDescriptionWarning(UserWarning):
    """A URDF file may not mean what its author wanted; the text says what it means."""


class XmlReader:
    """Reads attributes of one file. Its errors name the file, the line and the element.

    Raises:
        RobotDescriptionError: The file is not XML.
        OSError: The file cannot be read.
    """

    def __init__(self, path: Path):
        self.path = path
        self.lines: dict[ElementTree.Element, int] = {}
        self.root = self._parse()

    def _parse(self) -> ElementTree.Element:
        # The parser of ElementTree does not report the line of an element.
        tree = ElementTree.TreeBuilder()
        parser = expat.ParserCreate()
        parser.buffer_text = True
        opened: list[str] = []

        def start(tag: str, attributes: dict[str, str]) -> None:
            self.lines[tree.start(tag, attributes)] = parser.CurrentLineNumber
            opened.append(tag)

        def end(tag: str) -> None:
            tree.end(tag)
            opened.pop()

        parser.StartElementHandler = start
        parser.EndElementHandler = end
        parser.CharacterDataHandler = tree.data
        try:
            parser.Parse(self.path.read_bytes(), True)
        except expat.ExpatError as error:
            where = f"in <{opened[-1]}>" if opened else "outside any element"
            raise RobotDescriptionError(
                f"{self.path}, line {error.lineno}, {where}: malformed XML: "
                f"{expat.errors.messages[error.code]}"
            ) from error
        except LookupError as error:
            raise RobotDescriptionError(
                f"{self.path}, line 1, outside any element: malformed XML: {error}"
            ) from error
        return tree.close()

    def error(self, element: ElementTree.Element, text: str) -> RobotDescriptionError:
        """Returns an error that names the file, the line and the element."""
        name = element.get("name")
        label = f"<{element.tag} name={name!r}>" if name else f"<{element.tag}>"
        return RobotDescriptionError(
            f"{self.path}, line {self.lines[element]}, {label}: {text}"
        )

    def refused(
        self, element: ElementTree.Element, name: str, value: object, allowed: str
    ) -> RobotDescriptionError:
        """Returns an error about a value that begins with file, line and element."""
        return self.error(element, message(name, value, allowed))

    def text(self, element: ElementTree.Element, key: str) -> str:
        """Returns an attribute.

        Raises:
            RobotDescriptionError: The attribute is missing or empty.
        """
        value = element.get(key)
        if not value:
            raise self.error(element, f"attribute {key!r} is missing")
        return value

    def child(self, element: ElementTree.Element, tag: str) -> ElementTree.Element:
        """Returns the first child element with a tag.

        Raises:
            RobotDescriptionError: The element has no child with this tag.
        """
        found = element.find(tag)
        if found is None:
            raise self.error(element, f"element <{tag}> is missing")
        return found

    def numbers(
        self,
        element: ElementTree.Element,
        key: str,
        count: int,
        default: str | None = None,
        *,
        finite: bool = True,
    ) -> np.ndarray:
        """Returns the ``count`` numbers of an attribute.

        Raises:
            RobotDescriptionError: The attribute is missing, has the wrong number of
                values, or one that is not finite or above ``LARGEST`` (with
                ``finite=False``: not a number).
        """
        text = element.get(key, default)
        if text is None:
            raise self.error(element, f"attribute {key!r} is missing")
        try:
            # Python reads 1_0 as 10, which is no number elsewhere
            parts = [] if "_" in text else text.split()
            values = np.array([float(part) for part in parts])
        except ValueError:
            values = np.empty(0)
        valid = np.abs(values) <= LARGEST if finite else ~np.isnan(values)
        if len(values) != count or not valid.all():
            allowed = f"{count} finite number(s) up to {LARGEST:g}"
            raise self.refused(element, key, text, allowed)
        return values

    def number(
        self, element: ElementTree.Element, key: str, default: str | None = None
    ) -> float:
        """Returns the number in an attribute.

        Raises:
            RobotDescriptionError: The attribute is missing, or is not one finite
                number.
        """
        return float(self.numbers(element, key, 1, default)[0])

    def positive(
        self,
        element: ElementTree.Element,
        key: str,
        count: int,
        *,
        or_zero: bool = False,
    ) -> np.ndarray:
        """Returns the ``count`` numbers of an attribute, all above zero.

        With ``or_zero``, zero is allowed, too.

        Raises:
            RobotDescriptionError: The attribute is missing, has the wrong number of
                values, or one that is not finite or not above zero.
        """
        values = self.numbers(element, key, count)
        if not ((values >= 0) if or_zero else (values > 0)).all():
            allowed = "numbers from 0" if or_zero else "positive numbers"
            raise self.refused(element, key, element.get(key), allowed)
        return values

    def frame(self, element: ElementTree.Element) -> np.ndarray:
        """Returns the frame (7,) of the element's ``<origin>``.

        Raises:
            RobotDescriptionError: The numbers of ``<origin>`` are malformed, or it has
                a quaternion.
        """
        origin = element.find("origin")
        if origin is None:
            return IDENTITY
        if (quaternion := origin.get("quat_xyzw")) is not None:
            allowed = 'rpy="roll pitch yaw" in place of a quaternion'
            raise self.refused(origin, "quat_xyzw", quaternion, allowed)
        position = self.numbers(origin, "xyz", 3, "0 0 0")
        roll, pitch, yaw = self.numbers(origin, "rpy", 3, "0 0 0")
        return np.concatenate([position, rpy_quaternion(roll, pitch, yaw)])
