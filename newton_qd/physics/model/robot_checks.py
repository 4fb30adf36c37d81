"""Checks a ``RobotSpec``. Each error names the field, its value and what is allowed."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable

from newton_qd import checks
from newton_qd.checks import Fact, listed, message
from newton_qd.physics.model.xml_reader import RobotDescriptionError
from newton_qd.robots import Contact, Material, RobotSpec

_MAY_BE_ZERO = ("gravity", "friction", "dissipation", "limit_dissipation")


def _is_name(entry: object) -> bool:
    return isinstance(entry, str)


def _is_named_value(entry: object) -> bool:
    return isinstance(entry, tuple) and len(entry) == 2 and _is_name(entry[0])


def _is_contact(entry: object) -> bool:
    return isinstance(entry, Contact)


def _is_pair(entry: object) -> bool:
    return isinstance(entry, tuple) and len(entry) == 2 and all(map(_is_contact, entry))


# Fields that are tuples: the check of an entry, and the text of what is allowed.
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


def refusal(
    robot: RobotSpec, field: str, value: object, allowed: str, *, why: str = ""
) -> RobotDescriptionError:
    """Returns an error for a field of a robot."""
    name = f"robot {robot.name!r}, {field}"
    return RobotDescriptionError(message(name, value, allowed, why=why))


def index_of(
    robot: RobotSpec, field: str, name: str, allowed: tuple[str, ...], what: str = ""
) -> int:
    """Returns the index of the name of a link or joint in ``allowed``.

    ``what`` says for the error what the names have in common, for example ``"a moving
    link "``.

    Raises:
        RobotDescriptionError: The name is not in ``allowed``.
    """
    if not name or name not in allowed:
        known = listed([known for known in allowed if known])
        why = f"which is not {what}in {robot.urdf}"
        raise refusal(robot, field, name, known, why=why)
    return allowed.index(name)


def _check_number(robot: RobotSpec, field: str, value: float, *, signed: bool) -> None:
    zero = field.split(".")[-1] in _MAY_BE_ZERO
    checks.number(
        f"robot {robot.name!r}, {field}",
        value,
        least=0 if zero and not signed else None,
        above=None if zero or signed else 0,
        error=RobotDescriptionError,
    )


def _check_unique(robot: RobotSpec, field: str, names: list[str]) -> None:
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise refusal(robot, field, Fact(f"{listed(twice)} twice"), "each once")


def _pair_name(pair: tuple[Contact, Contact]) -> str:
    """Returns a name of a pair that does not depend on the order of its sides."""
    ends = (":".join(filter(None, (end.link, end.collider))) for end in pair)
    return " and ".join(sorted(ends))


def _check_types(robot: RobotSpec) -> None:
    """Checks the types of a robot's fields, but not their values.

    Raises:
        TypeError: ``robot`` is not a ``RobotSpec``.
        RobotDescriptionError: A field has the wrong type.
    """
    allowed = "a RobotSpec, such as newton_qd.robots.ANT"
    checks.instance("robot", robot, RobotSpec, allowed)
    checks.text("robot, name", robot.name, error=RobotDescriptionError)
    if not isinstance(robot.urdf, (str, os.PathLike)):
        raise refusal(robot, "urdf", robot.urdf, 'a path, such as "robot.urdf"')
    for field, (is_entry, allowed) in _TUPLES.items():
        value = getattr(robot, field)
        # A string is a sequence too. It would be read as one name per letter.
        if not isinstance(value, tuple):
            raise refusal(robot, field, value, allowed)
        for index, entry in enumerate(value):
            if not is_entry(entry):
                raise refusal(robot, f"{field}[{index}]", entry, allowed)
    rotation = robot.rest_rotation
    if not isinstance(rotation, tuple) or len(rotation) != 3:
        allowed = "a tuple of roll, pitch and yaw"
        raise refusal(robot, "rest_rotation", rotation, allowed)
    if robot.fixed_base is not None and not isinstance(robot.fixed_base, bool):
        raise refusal(robot, "fixed_base", robot.fixed_base, "None, True, False")
    if not isinstance(robot.material, Material):
        raise refusal(robot, "material", robot.material, "a Material")


def _check_names(robot: RobotSpec, field: str, contact: Contact) -> None:
    """Checks that the names of a contact are text."""
    text = 'a name, such as "foot"'
    if not isinstance(contact.link, str):
        raise refusal(robot, f"{field}: link", contact.link, text)
    if not isinstance(contact.collider, (str, type(None))):
        raise refusal(robot, f"{field}: collider", contact.collider, f"None, {text}")


def _check_contacts(robot: RobotSpec) -> None:
    """Checks names and ``end`` of each contact, also in pairs."""
    for contact in robot.contacts:
        _check_names(robot, "contacts", contact)
    for pair in robot.pairs:
        for contact in pair:
            _check_names(robot, "pairs", contact)
    for contact in robot.contacts:
        if contact.end not in (-1, 0, 1):
            field = f"contacts: end of {contact.link!r}"
            raise refusal(robot, field, contact.end, "-1, 0, 1")
    for pair in robot.pairs:
        for contact in pair:
            if contact.end != 0:
                field = f"pairs: end of {contact.link!r}"
                raise refusal(robot, field, contact.end, "0, the whole collider")


def check_robot(robot: RobotSpec) -> None:
    """Checks everything in a ``RobotSpec`` that does not need its file.

    Raises:
        TypeError: ``robot`` is not a ``RobotSpec``.
        RobotDescriptionError: A field has the wrong type, a number is not finite or
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
            allowed = listed(driven, "none, as actuators is empty")
            raise refusal(robot, "servos", joint, allowed, why="which is not driven")
    checks.integer(
        f"robot {robot.name!r}, substeps",
        robot.substeps,
        most=None,
        optional=True,
        error=RobotDescriptionError,
    )
    _check_contacts(robot)
    _check_unique(robot, "actuators", [joint for joint, _ in robot.actuators])
    _check_unique(robot, "servos", list(robot.servos))
    _check_unique(robot, "rest_pose", [joint for joint, _ in robot.rest_pose])
    _check_unique(robot, "feet", list(robot.feet))
    _check_unique(robot, "pairs", [_pair_name(pair) for pair in robot.pairs])


def check_feet(robot: RobotSpec) -> None:
    """Checks that each foot has a contact; the contacts are checked before.

    Raises:
        RobotDescriptionError: A foot has no contact.
    """
    touching = {contact.link for contact in robot.contacts}
    for foot in robot.feet:
        if foot not in touching:
            allowed = listed(sorted(touching), "none, as contacts is empty")
            raise refusal(robot, "feet", foot, allowed, why="which has no contact")
