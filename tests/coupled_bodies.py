"""A robot whose limbs touch each other at four pairs at once, and its dense solve."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from moving_bodies import UNLIMITED, body
from physics_helpers import contact_law, penetration
from urdf_text import joint, link, row, write

from newton_qd import physics
from newton_qd.physics import reference
from newton_qd.physics.model import build_system
from newton_qd.physics.system import JointKind, System
from newton_qd.robots import Contact, Material

RADIUS = 0.05
SIDE = 0.095  # of the tetrahedron of the four balls: they are 5 mm deep [m]
LOW = 0.2  # of three of the balls below the torso [m]
PAIRS = (("a", "b"), ("b", "c"), ("c", "a"), ("d", "c"))
ANGLES = {"a": 0.0, "b": 2 * np.pi / 3, "c": 4 * np.pi / 3}
TOP = np.array([0.0, 0.0, SIDE * np.sqrt(2 / 3) - LOW])  # ball of d


def numbers(values: Any) -> str:
    return " ".join(f"{value:.17g}" for value in values)


def around(angle: float, radius: float, height: float) -> np.ndarray:
    return np.array([radius * np.cos(angle), radius * np.sin(angle), height])


def limb(name: str, mass: float, tip: np.ndarray) -> str:
    """A link with a ball at ``tip``, its centre of mass half way."""
    inertia = f'ixx="{0.01 * mass}" iyy="{0.02 * mass}" izz="{0.015 * mass}"'
    return f"""<link name="{name}"><inertial><origin xyz="{numbers(tip / 2)}"/>
      <mass value="{mass}"/><inertia {inertia} ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><origin xyz="{numbers(tip)}"/><geometry>
      <sphere radius="{RADIUS}"/></geometry></collision></link>"""


def hinged(parent: str, name: str, mass: float, at: np.ndarray, tip: np.ndarray) -> str:
    """A limb that turns at ``at``, in the parent's frame; ``tip`` as there."""
    inside = f'<origin xyz="{numbers(at)}"/><axis xyz="{numbers([0.6, 0.8, 0.1])}"/>'
    return joint(name, "continuous", parent, name, inside) + limb(name, mass, tip - at)


def coupled_text(free: bool) -> str:
    """Three arms on a torso; ``d`` is a hand of ``a``, or a body of its own."""
    tips = {name: around(at, SIDE / np.sqrt(3), -LOW) for name, at in ANGLES.items()}
    hinges = {name: around(at, 0.25, 0.0) for name, at in ANGLES.items()}
    arms = hinged("torso", "a", 0.4, hinges["a"], tips["a"])
    arms += hinged("torso", "b", 0.7, hinges["b"], tips["b"])
    # an arm that also slides, before it turns
    inside = f'<axis xyz="0 0 1"/>{UNLIMITED}'
    arms += joint("lift", "prismatic", "torso", "lift", inside) + '<link name="lift"/>'
    arms += hinged("lift", "c", 0.3, hinges["c"], tips["c"])
    if free:
        arms += hinged("a", "d", 0.2, np.array([-0.1, 0.05, 0.0]), TOP - hinges["a"])
        root = link("torso", mass=3.0)
    else:
        root = '<link name="world"/>' + body("torso", "", slides="xz", turns="y")
        arms += body("d", f"<collision>{BALL}</collision>", mass=0.2)
    return f'<robot name="coupled">{root}{arms}</robot>'


BALL = f'<geometry><sphere radius="{RADIUS}"/></geometry>'


def coupled_system(
    folder: Path,
    free: bool,
    ground: bool = True,
    backwards: bool = False,
    friction: float = 1.0,
) -> System:
    """Four pairs, one contact with the ground; joints damped, with armature, sprung."""
    pairs = tuple((Contact(a), Contact(b)) for a, b in PAIRS)
    if backwards:
        pairs = tuple((b, a) for a, b in reversed(pairs))
    robot = row(
        write(folder, coupled_text(free)),
        "torso",
        dt=0.005,
        substeps=1,
        pairs=pairs,
        contacts=(Contact("b"),) if ground else (),
        gravity=9.81 if ground else 0.0,
        material=Material(support=1, friction=friction),
    )
    system = build_system(robot, "float64")
    rng = np.random.default_rng(0)
    inner = np.arange(system.nv) >= (6 if free else 3)
    armature, damping, stiffness, rest = rng.uniform(0.02, 0.1, (4, system.nv)) * inner
    return dataclasses.replace(
        system,
        armature=armature,
        damping=damping,
        stiffness=stiffness,
        spring_rest=rest,
    )


def touching_states(
    system: System, rng: np.random.Generator, worlds: int
) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates and velocities; all four pairs and the ground touch."""
    free = system.joint_kind[0] == JointKind.FREE
    q = np.zeros((worlds, system.nq))
    q[:, 7 * free :] = rng.uniform(-0.004, 0.004, (worlds, system.nv - 6 * free))
    height = LOW + RADIUS - 0.004
    if free:
        q[:, 6] = 1.0
        q[:, 2] = height
    else:
        names = system.body_names
        q[:, system.q_start[names.index("torso_1")]] += height
        for axis, link in enumerate(("d_0", "d_1", "d")):
            q[:, system.q_start[names.index(link)]] += TOP[axis]
        q[:, system.q_start[names.index("d")]] += height
    return q, 0.5 * rng.normal(size=(worlds, system.nv))


@dataclasses.dataclass(frozen=True)
class Touch:
    """A contact of two bodies, or of one with the ground.

    Attributes:
        bodies: Bodies and the signs of the impulse on them.
        point: (3,) [m].
        normal: (3,) towards the first body.
        gap: Gap [m].
        motion: (3, nv) velocity of parting per velocity.
    """

    bodies: list[tuple[int, float]]
    point: np.ndarray
    normal: np.ndarray
    gap: float
    motion: np.ndarray


def centres_of_mass(system: System, q: np.ndarray) -> np.ndarray:
    frames = reference.body_frames(system, q)
    turns = np.array([reference.rotation_matrix(frame[3:]) for frame in frames])
    return frames[:, :3] + np.einsum("bij,bj->bi", turns, system.com)


def touches(system: System, q: np.ndarray) -> list[Touch]:
    """The contacts of balls, in the kernels' geometry."""
    frames = reference.body_frames(system, q)
    coms = centres_of_mass(system, q)
    linear, angular = reference.jacobians(system, q)
    gaps = np.asarray(physics.contact_gaps(system, jnp.asarray(q)))
    places = [
        frames[i, :3] + reference.rotation_matrix(frames[i, 3:]) @ position
        for i, position in zip(
            system.contact_body, system.contact_position, strict=True
        )
    ]

    def touch(c: int, at: np.ndarray, n: np.ndarray, bodies: Any) -> Touch:
        motion = np.zeros((3, system.nv))
        for i, sign in bodies:
            motion += sign * (linear[i] + np.cross(angular[i].T, at - coms[i]).T)
        return Touch(bodies, at, n, float(gaps[c]), motion)

    found = []
    for a, b in system.contact_pairs:
        away = places[a] - places[b]
        n = away / np.sqrt(1e-10 + away @ away)  # the kernels' lengths are never 0
        at = places[a] - (system.contact_radius[a] + 0.5 * gaps[a]) * n
        i, j = system.contact_body[[a, b]]
        found.append(touch(a, at, n, [(i, 1.0), (j, -1.0)]))
    for c in system.ground_contacts:
        n = np.array([0.0, 0.0, 1.0])
        at = places[c] - system.contact_radius[c] * n
        found.append(touch(c, at, n, [(system.contact_body[c], 1.0)]))
    return found


def dense_step(
    system: System, q: np.ndarray, v: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """New velocity (nv,), impulses (nb, 6) and normal impulses (nb,) of one substep.

    Without friction, and in two solves: the law linearised about the velocity at the
    start, then the impulses that it gives.
    """
    h = system.robot.dt
    contacts = touches(system, q)
    coordinate = np.zeros(system.nv)
    inner = system.joint_kind != JointKind.FREE
    coordinate[system.v_start[inner]] = q[system.q_start[inner]]
    spring = system.stiffness * (coordinate + h * v - system.spring_rest)
    force = -np.asarray(physics.bias_forces(system, jnp.asarray(q), jnp.asarray(v)))
    force = force - spring - system.damping * v
    matrix = np.asarray(physics.mass_matrix(system, jnp.asarray(q)))
    matrix = matrix + np.diag(h * system.damping + h * h * system.stiffness)
    total, right = matrix.copy(), h * force
    laws = []
    for contact in contacts:
        row = contact.normal @ contact.motion
        law, slope = contact_law(system, h, contact.gap, float(row @ v), follows=0.0)
        total += slope * np.outer(row, row)
        right = right + law * row
        laws.append((law, slope, row))
    change = np.linalg.solve(total, right)
    given = [
        float(penetration(slope * (row @ change) - law, 0.5 * law))
        for law, slope, row in laws
    ]
    right = h * force
    for (_, _, row), load in zip(laws, given, strict=True):
        right = right + load * row
    change = np.linalg.solve(matrix, right)
    impulse, normal = np.zeros((system.nb, 6)), np.zeros(system.nb)
    coms = centres_of_mass(system, q)
    for contact, load in zip(contacts, given, strict=True):
        for i, sign in contact.bodies:
            applied = sign * load * contact.normal
            impulse[i, :3] += applied
            impulse[i, 3:] += np.cross(contact.point - coms[i], applied)
            normal[i] += load
    return v + change, impulse, normal
