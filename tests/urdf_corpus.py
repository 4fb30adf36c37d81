"""URDF files of public packages, for tests: where they are, and how a robot is made."""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import newton
import numpy as np

from newton_qd.physics import reference
from newton_qd.physics.model import build_system
from newton_qd.physics.model.description import read_description
from newton_qd.physics.system import System
from newton_qd.robots import Contact, RobotSpec

PACKAGES = {
    # name: requirement, folder of its robots in the wheel, licence
    "example": (
        "example-robot-data==6.0.0",
        "cmeel.prefix/share/example-robot-data/robots",
        "BSD-3-Clause",
    ),
    "fingers": (
        "robot-properties-fingers==2.0.2",
        "robot_properties_fingers/urdf",
        "BSD-3-Clause",
    ),
    "upkie": ("upkie-description==2.2.0", "upkie_description/urdf", "Apache-2.0"),
    "airo": ("airo-models==0.0.12", "airo_models", "MIT"),
}
_SECONDS = 300  # for the download of one package


class UnavailableError(Exception):
    """A package cannot be downloaded here."""


def fetched(package: str, cache: Path) -> Path:
    """Returns the folder of a package's robots; it is downloaded once.

    Only the URDF files are kept. Other files become empty, because the physics asks
    whether a mesh exists, and never reads it.

    Raises:
        UnavailableError: Without a network, or without pip.
    """
    if package == "newton":
        return Path(newton.__file__).parent
    requirement, folder, _ = PACKAGES[package]
    unpacked = cache / requirement
    if not unpacked.is_dir():
        part = cache / f"{requirement}.{os.getpid()}"
        wheel = _wheel(requirement, part / "wheel")
        with zipfile.ZipFile(wheel) as archive:
            for item in archive.infolist():
                if item.is_dir():
                    continue
                path = part / item.filename
                path.parent.mkdir(parents=True, exist_ok=True)
                keep = path.suffix == ".urdf"
                path.write_bytes(archive.read(item) if keep else b"")
        shutil.rmtree(wheel.parent)
        part.rename(unpacked)
    return unpacked / folder


def _wheel(requirement: str, target: Path) -> Path:
    options = ["--no-deps", "--only-binary=:all:", "--retries=1", "--timeout=15"]
    command = [sys.executable, "-m", "pip", "download", "--quiet", *options]
    try:
        subprocess.run(
            [*command, "--dest", str(target), requirement],
            check=True,
            capture_output=True,
            text=True,
            timeout=_SECONDS,
        )
    except subprocess.TimeoutExpired as error:
        raise UnavailableError(f"{requirement}: no answer in {_SECONDS} s") from error
    except subprocess.CalledProcessError as error:
        last = (error.stderr.strip().splitlines() or ["no message"])[-1]
        raise UnavailableError(f"{requirement}: {last}") from error
    return next(target.glob("*.whl"))


def system_of(path: Path, fixed_base: bool | None) -> System:
    """Builds the robot of a file: all joints driven, and spheres that touch.

    The default pose is 0, or the middle of the limits if they exclude 0. The gear of a
    joint accelerates it by 10 rad/s^2 or m/s^2 with all other joints locked.
    """
    description = read_description(path, fixed_base)
    spheres = [
        shape.link
        for body in description.bodies.values()
        for shape in body.shapes
        if shape.kind == "sphere"
    ]
    joints = [body.joint for body in description.bodies.values() if body.joint]
    robot = RobotSpec(
        path.stem,
        str(path.absolute()),
        next(iter(description.bodies)),
        contacts=tuple(Contact(x) for x in spheres if spheres.count(x) == 1),
        rest_pose=tuple(
            (joint.name, (joint.lower + joint.upper) / 2)
            for joint in joints
            if not joint.lower <= 0 <= joint.upper
        ),
        dt=0.02,
        substeps=4,
        fixed_base=fixed_base,
    )
    system = build_system(robot, "float32")
    inertia = np.diag(reference.mass_matrix(system, system.rest_q))
    actuators = tuple(
        (name, 10.0 * float(inertia[dof]))
        for name, dof in zip(system.joint_names, system.v_start, strict=True)
        if name
    )
    return build_system(dataclasses.replace(robot, actuators=actuators), "float32")
