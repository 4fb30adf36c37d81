"""A robot's torso and feet on links that are fixed to each other."""

from __future__ import annotations

from pathlib import Path

import pytest
from urdf_text import built, joint, link, robot_text, sphere

from newton_qd.physics.model import RobotDescriptionError
from newton_qd.robots import Contact


def skid(low: str, high: str) -> str:
    """A body with a fixed skid at ``low``, and another one at ``high``."""
    at = '<origin xyz="{}"/>'
    return robot_text(
        link("body"),
        link("low", sphere(0.05)),
        link("high", sphere(0.05)),
        joint("a", "fixed", "body", "low", at.format(low)),
        joint("b", "fixed", "body", "high", at.format(high)),
    )


def test_two_feet_are_two_bodies(tmp_path: Path) -> None:
    """Contacts are summed by body, so both would read the same."""
    contacts = (Contact("low"), Contact("high"))
    text = skid("0 0 -0.3", "0 0 5")
    assert len(built(tmp_path, text, "body", contacts=contacts, feet=("low",)).feet)
    with pytest.raises(
        RobotDescriptionError, match=r"'low' and 'high', .*touch as one"
    ):
        built(tmp_path, text, "body", contacts=contacts, feet=("low", "high"))


def test_a_torso_has_the_frame_of_its_body(tmp_path: Path) -> None:
    """The position of the robot is that of its frame."""
    text = skid("0 0 0", "1 2 0.5")
    assert built(tmp_path, text, "low").torso == 0
    half = '<origin rpy="0 0 3.14159"/>'  # twice: the quaternion (0, 0, 0, -1)
    turned = robot_text(
        *(link(name) for name in "abc"),
        joint("one", "fixed", "a", "b", half),
        joint("two", "fixed", "b", "c", half),
    )
    assert built(tmp_path, turned, "c").torso == 0
    with pytest.raises(RobotDescriptionError, match="'b', which is fixed to 'a'"):
        built(tmp_path, turned, "b")
    allowed = r"fixed to 'body', at another place or turned; allowed: body, low$"
    with pytest.raises(RobotDescriptionError, match=allowed):
        built(tmp_path, text, "high")
