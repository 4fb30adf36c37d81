"""What a URDF file may just say, and what just not."""

from __future__ import annotations

import math
import warnings
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from urdf_text import built, joint, link, refusal, robot_text, sphere, write

from newton_qd import physics
from newton_qd.physics import reference
from newton_qd.physics.model import RobotDescriptionWarning
from newton_qd.physics.model.description import read_description
from newton_qd.physics.model.elements import is_real
from newton_qd.physics.model.verify import _same_frame
from newton_qd.robots import Contact

TWO = link("a"), link("b")


@pytest.mark.parametrize(
    ("lower", "upper", "expected"),
    [
        ("-1e9", "1e9", (-math.inf, math.inf)),
        ("-9.99e8", "9.99e8", (-9.99e8, 9.99e8)),
        ("0", "0", (0.0, 0.0)),
    ],
)
def test_limits_of_a_joint(
    lower: str, upper: str, expected: tuple[float, float], tmp_path: Path
) -> None:
    limit = f'<limit lower="{lower}" upper="{upper}"/>'
    system = built(
        tmp_path, robot_text(*TWO, joint("j", "prismatic", "a", "b", limit)), "a"
    )
    assert (system.limit_lower[6], system.limit_upper[6]) == expected


@pytest.mark.parametrize(("excess", "real"), [(1e-6, True), (1e-5, False)])
def test_moments_may_be_rounded(excess: float, real: bool) -> None:
    assert is_real(1.0, np.diag([1.0, 1.0, 2.0 + excess])) == real


def test_opposite_quaternions_are_one_frame() -> None:
    frame = np.array([1.0, 2.0, 3.0, 0.6, 0.0, 0.0, 0.8])
    assert _same_frame(frame, frame * [1, 1, 1, -1, -1, -1, -1])
    assert not _same_frame(frame, frame * [1, 1, 1, -1, 1, 1, 1])


def test_a_turned_box_touches_with_its_corners(tmp_path: Path) -> None:
    origin = '<origin xyz="0.1 0.2 0.3" rpy="0.3 -0.2 0.5"/>'
    box = f'<collision>{origin}<geometry><box size="2 4 6"/></geometry></collision>'
    system = built(tmp_path, robot_text(link("a", box)), "a", contacts=(Contact("a"),))
    turn = reference.rotation_matrix(reference.rpy_quaternion(0.3, -0.2, 0.5))
    local = (system.contact_position - [0.1, 0.2, 0.3]) @ turn
    np.testing.assert_allclose(np.abs(local), np.tile([1.0, 2.0, 3.0], (8, 1)))
    assert len(np.unique(np.sign(local), axis=0)) == 8


def test_a_chain_that_newton_cannot_read_is_refused(tmp_path: Path) -> None:
    """Longer than the calls inside each other that Python allows."""
    names = [f"link{i}" for i in range(1200)]
    joints = [joint(f"j_{b}", "continuous", a, b) for a, b in pairwise(names)]
    text = robot_text(*map(link, names), *joints)
    assert list(read_description(Path(write(tmp_path, text))).bodies) == names
    error = refusal(tmp_path, text, names[-1])
    assert error.endswith("chain of joints: got about 1,000 or more; allowed: hundreds")


SLIDES = {  # joints from the world to the torso, and what places it on the ground
    "a slide": ("z", (0, 1.0)),
    "a slide behind a hinge": ("hz", None),
    "a slide behind a hinge about it": ("tz", (1, 1.0)),
    "a slide behind both": ("htz", None),
    "a slide before the hinge": ("zh", (0, 1.0)),
    "a slide before and one behind": ("zhz", (0, 1.0)),
}
AXES = {"z": "0 0 1", "t": "0 0 1", "h": "0 1 0"}


@pytest.mark.parametrize("name", SLIDES)
def test_a_slide_that_a_hinge_tilts_grounds_nothing(name: str, tmp_path: Path) -> None:
    """In another pose it would move the torso sideways, and not onto the ground."""
    kinds, expected = SLIDES[name]
    names = ["world", *(f"link{i}" for i in range(len(kinds)))]
    parts = ['<link name="world"/>', *(link(n, sphere(0.1)) for n in names[1:])]
    for index, kind in enumerate(kinds):
        axis = f'<axis xyz="{AXES[kind]}"/><origin xyz="0 0 0.3"/>'
        role = "prismatic" if kind == "z" else "continuous"
        parts.append(joint(f"j{index}", role, names[index], names[index + 1], axis))
    torso = names[-1]
    system = built(tmp_path, robot_text(*parts), torso, contacts=(Contact(torso),))
    assert physics.grounding_coordinate(system) == expected
    assert reference.lowest_contact(system, system.rest_q) == pytest.approx(0, abs=1e-9)


REFUSED = {
    "two shapes": (
        link("a", sphere(0.1).replace("</geometry>", "<cone/></geometry>")),
        "<geometry>: shape: got sphere, cone; allowed: exactly one",
    ),
    "two origins of a collider": (
        link("a", sphere(0.1).replace("<geometry>", "<origin/><geometry>")),
        "second <origin> of this collision",
    ),
    "a number whose square overflows": (
        link("a", mass=1.1e9),
        "value: got '1100000000.0'; allowed: 1 finite number(s) up to 1e+09",
    ),
    "a world of mass": (
        link("world") + link("a") + joint("j", "continuous", "world", "a"),
        "link: got a collider or a mass; allowed: neither on a robot's world link",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_elements(name: str, tmp_path: Path) -> None:
    text, message = REFUSED[name]
    assert message in refusal(tmp_path, robot_text(text), "a")


DEGREES = {
    '<origin rpy="0 90 0"/>': "<origin>: rpy: got 0 90 0, which looks like degrees",
    '<limit lower="-45" upper="1.5"/>': "<limit>: lower: got -45, which looks like",
    '<limit lower="0" upper="180.0"/>': "<limit>: upper: got 180.0, which looks like",
}


@pytest.mark.parametrize("angle", DEGREES)
def test_degrees_are_noticed(angle: str, tmp_path: Path) -> None:
    bounds = "" if "limit" in angle else '<limit lower="-1" upper="1"/>'
    hinge = joint("hinge", "revolute", "a", "b", angle + bounds)
    text = robot_text(link("a"), link("b"), hinge)
    with pytest.warns(RobotDescriptionWarning, match=DEGREES[angle]):
        built(tmp_path, text, "a")


@pytest.mark.parametrize(
    ("kind", "inside"),
    [
        ("revolute", '<origin rpy="6.2832 -6.2832 3"/><limit lower="-12" upper="12"/>'),
        ("revolute", '<limit lower="-27.7" upper="27.7"/>'),  # of an arm on the market
        ("revolute", '<limit lower="-10000" upper="10000"/>'),  # means no limit
        ("prismatic", '<limit lower="-20" upper="20"/>'),
    ],
)
def test_other_angles_are_not(kind: str, inside: str, tmp_path: Path) -> None:
    text = robot_text(link("a"), link("b"), joint("moved", kind, "a", "b", inside))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        built(tmp_path, text, "a")


@pytest.mark.parametrize("angle", ["0 90 0", "here"])
def test_a_frame_that_means_nothing_is_not_read(angle: str, tmp_path: Path) -> None:
    """A link has no ``<origin>`` of its own."""
    text = robot_text(
        link("a", f'<origin rpy="{angle}"/>'),
        link("b"),
        joint("moved", "continuous", "a", "b"),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        built(tmp_path, text, "a")
