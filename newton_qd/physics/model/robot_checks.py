"""Checks of a robot's row; every error names the field, its value, what is allowed."""

from __future__ import annotations

import dataclasses
import math
import numbers
import os
from collections.abc import Callable

from newton_qd.physics.model.xml_reader import RobotDescriptionError
from newton_qd.robots import Contact, Material, RobotSpec

_MAY_BE_ZERO = ("gravity", "friction", "dissipation")


def _is_name(entry: object) -> bool:
    return isinstance(entry, str)


def _is_named_value(entry: object) -> bool:
    return isinstance(entry, tuple) and len(entry) == 2 and _is_name(entry[0])


def _is_contact(entry: object) -> bool:
    return isinstance(entry, Contact)


def _is_pair(entry: object) -> bool:
    return isinstance(entry, tuple) and len(entry) == 2 and all(map(_is_contact, entry))


# Fields that are tuples: what an entry is, and how the field is written.
_TUPLES: dict[str, tuple[Callable[[object], bool], str]] = {
    "feet": (_is_name, 'a tuple of links, such as ("foot",)'),
    "actuators": (
        _is_named_value,
        'a tuple of (joint, gear), such as (("hip", 30.0),)',
    ),
    "contacts": (_is_contact, 'a tuple of Contact, such as (Contact("foot"),)'),
    "rest_pose": (
        _is_named_value,
        'a tuple of (joint, angle), such as (("knee", 0.8),)',
    ),
    "servos": (_is_name, 'a tuple of joints, such as ("hip",)'),
    "pairs": (
        _is_pair,
        "a tuple of pairs of Contact, such as "
        '((Contact("foot"), Contact("other_foot")),)',
    ),
}


def index_of(robot: RobotSpec, field: str, name: str, allowed: tuple[str, ...]) -> int:
    """Returns the position of a link's or joint's name in ``allowed``.

    Raises:
        RobotDescriptionError: The row's field names something that is not there.
    """
    if not name or name not in allowed:
        known = ", ".join(known for known in allowed if known)
        raise RobotDescriptionError(
            f"robot {robot.name!r}, {field}: {name!r} is not in {robot.urdf}; "
            f"allowed: {known}"
        )
    return allowed.index(name)


def _check_number(robot: RobotSpec, field: str, value: float, *, signed: bool) -> None:
    zero = field.split(".")[-1] in _MAY_BE_ZERO
    valid = (
        isinstance(value, numbers.Real)
        and math.isfinite(value)
        and (signed or value > 0 or (zero and value == 0))
    )
    if not valid:
        allowed = "finite" if signed else "finite, " + ("0 or more" if zero else "> 0")
        raise RobotDescriptionError(
            f"robot {robot.name!r}, {field}={value!r}; allowed: {allowed}"
        )


def _check_unique(robot: RobotSpec, field: str, names: list[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise RobotDescriptionError(
            f"robot {robot.name!r}, {field}: {', '.join(twice)} named twice; "
            "allowed: once"
        )


def _pair_name(pair: tuple[Contact, Contact]) -> str:
    """Name of a pair, in whichever order it is written."""
    ends = (":".join(filter(None, (end.link, end.collider))) for end in pair)
    return " and ".join(sorted(ends))


def _check_types(robot: RobotSpec) -> None:
    """Checks that a row can be read: what its fields hold, not yet their values.

    Raises:
        TypeError: ``robot`` is not a row.
        RobotDescriptionError: A field is not of the type that it is read as.
    """
    if not isinstance(robot, RobotSpec):
        raise TypeError(
            f"robot={robot!r}: allowed: a RobotSpec, such as newton_qd.robots.ANT"
        )
    if not isinstance(robot.name, str) or not robot.name:
        raise RobotDescriptionError(
            f"robot, name={robot.name!r}; allowed: a text that is not empty"
        )
    if not isinstance(robot.urdf, (str, os.PathLike)):
        raise RobotDescriptionError(
            f"robot {robot.name!r}, urdf={robot.urdf!r}; allowed: a path, such as "
            '"robot.urdf"'
        )
    for field, (is_entry, allowed) in _TUPLES.items():
        value = getattr(robot, field)
        # a text is a sequence, too: read letter by letter, not as one name
        if not isinstance(value, tuple):
            raise RobotDescriptionError(
                f"robot {robot.name!r}, {field}={value!r}; allowed: {allowed}"
            )
        for index, entry in enumerate(value):
            if not is_entry(entry):
                raise RobotDescriptionError(
                    f"robot {robot.name!r}, {field}[{index}]={entry!r}; allowed: "
                    f"{allowed}"
                )
    rotation = robot.rest_rotation
    if not isinstance(rotation, tuple) or len(rotation) != 3:
        raise RobotDescriptionError(
            f"robot {robot.name!r}, rest_rotation={rotation!r}; allowed: a tuple of "
            "roll, pitch and yaw"
        )
    if not isinstance(robot.material, Material):
        raise RobotDescriptionError(
            f"robot {robot.name!r}, material={robot.material!r}; allowed: a Material"
        )


def _check_contacts(robot: RobotSpec) -> None:
    """Checks the ends of contacts and pairs."""
    for contact in robot.contacts:
        if contact.end not in (-1, 0, 1):
            raise RobotDescriptionError(
                f"robot {robot.name!r}, contacts: end={contact.end!r} of link "
                f"{contact.link!r}; allowed: -1, 0, 1"
            )
    for pair in robot.pairs:
        for contact in pair:
            if contact.end != 0:
                raise RobotDescriptionError(
                    f"robot {robot.name!r}, pairs: end={contact.end!r} of link "
                    f"{contact.link!r}; allowed: 0, the whole collider"
                )


def check_robot(robot: RobotSpec) -> None:
    """Checks the numbers of a row, and what can be checked without its file.

    Raises:
        TypeError: ``robot`` is not a row.
        RobotDescriptionError: A field is of another type, a number is not finite or
            has the wrong sign, or a name is given twice.
    """
    _check_types(robot)
    for field in ("dt", "gravity"):
        _check_number(robot, field, getattr(robot, field), signed=False)
    for field in dataclasses.fields(robot.material):
        value = getattr(robot.material, field.name)
        _check_number(robot, f"material.{field.name}", value, signed=False)
    if robot.rest_height is not None:
        _check_number(robot, "rest_height", robot.rest_height, signed=True)
    for joint, gear in robot.actuators:
        _check_number(robot, f"actuators: gear of {joint!r}", gear, signed=False)
    for joint, angle in robot.rest_pose:
        _check_number(robot, f"rest_pose: angle of {joint!r}", angle, signed=True)
    for angle in robot.rest_rotation:
        _check_number(robot, "rest_rotation: angle", angle, signed=True)
    driven = tuple(joint for joint, _ in robot.actuators)
    for joint in robot.servos:
        if joint not in driven:
            raise RobotDescriptionError(
                f"robot {robot.name!r}, servos: {joint!r} is not driven; allowed: "
                f"{', '.join(driven) or 'none, as actuators is empty'}"
            )
    substeps = robot.substeps
    if not isinstance(substeps, int) or isinstance(substeps, bool) or substeps < 1:
        raise RobotDescriptionError(
            f"robot {robot.name!r}, substeps={robot.substeps!r}; allowed: 1, 2, ..."
        )
    _check_contacts(robot)
    _check_unique(robot, "actuators", [joint for joint, _ in robot.actuators])
    _check_unique(robot, "rest_pose", [joint for joint, _ in robot.rest_pose])
    _check_unique(robot, "feet", list(robot.feet))
    _check_unique(robot, "pairs", [_pair_name(pair) for pair in robot.pairs])
    touching = {contact.link for contact in robot.contacts}
    for foot in robot.feet:
        if foot not in touching:
            raise RobotDescriptionError(
                f"robot {robot.name!r}, feet: {foot!r} has no contact; allowed: "
                f"{', '.join(sorted(touching)) or 'none, as contacts is empty'}"
            )
