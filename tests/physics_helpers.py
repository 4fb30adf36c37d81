"""What the physics tests share: random states, compiled steps, reference formulas."""

from __future__ import annotations

import dataclasses
import functools
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from urdf_text import row, write

from newton_qd import physics
from newton_qd.physics import reference
from newton_qd.physics.model import build_system
from newton_qd.physics.model.rest import raising_coordinate
from newton_qd.physics.system import JointKind, ObstacleKind, PhysicsState, System
from newton_qd.robots import ROBOTS, Contact, Material, RobotSpec

Arrays = tuple[np.ndarray, ...]

# One robot of each URDF file, and those of them that stand on the ground.
DISTINCT = list({row.urdf: name for name, row in reversed(ROBOTS.items())}.values())
DISTINCT.reverse()
STANDING = [name for name in DISTINCT if ROBOTS[name].feet]


def variant(robot: RobotSpec, dtype: str, **changes: Any) -> System:
    """A system of a changed row; cached, because a system compiles its own calls.

    Tests of single steps take longer substeps than motion allows.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", physics.FewSubstepsWarning)
        return physics.load_system(dataclasses.replace(robot, **changes), dtype)


def random_states(system: System, rng: np.random.Generator, worlds: int) -> Arrays:
    """Coordinates (n, nq), velocities (n, nv), actions (n, nu) of a legged robot.

    Its root is free or in a plane. The first half sinks, its lowest foot 10 to 20 mm
    deep in the ground; the second half is up to 0.5 m above it.
    """
    q = np.tile(system.rest_q, (worlds, 1))
    for body in np.flatnonzero(system.joint_kind != JointKind.FREE):
        dof, at = system.v_start[body], system.q_start[body]
        lower, upper = system.limit_lower[dof], system.limit_upper[dof]
        if np.isfinite(lower):
            q[:, at] = rng.uniform(lower - 0.1, upper + 0.1, worlds)
    tilt = 0.15 * rng.normal(size=(worlds, 4)) + np.array([0.0, 0.0, 0.0, 1.0])
    if system.joint_kind[0] == JointKind.FREE:
        q[:, 3:7] = tilt / np.linalg.norm(tilt, axis=1, keepdims=True)
        q[:, :2] = 5.0 * rng.normal(size=(worlds, 2))
    else:
        q[:, 2] = 2.0 * tilt[:, 1]
        q[:, 0] = 5.0 * rng.normal(size=worlds)
    raising = raising_coordinate(system)
    assert raising is not None
    up = raising[0]
    half = worlds // 2
    height = rng.uniform(-0.02, -0.01, worlds)
    height[half:] = rng.uniform(0.0, 0.5, worlds - half)
    for world in range(worlds):
        q[world, up] += height[world] - reference.lowest_contact(system, q[world])
    v = rng.normal(size=(worlds, system.nv))
    v[:half, up] = -np.abs(v[:half, up])
    return q, v, rng.uniform(-1.0, 1.0, (worlds, system.nu))


def beside_a_wall(
    system: System, q: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """The coordinates with every second robot moved within reach of the first wall."""
    frame, (radius, half, _) = system.obstacle_frame[1], system.obstacle_size[1]
    if system.obstacle_kind[1] == ObstacleKind.BOX:
        return beside_a_box(system, q, rng)
    axis = reference.rotation_matrix(frame[3:])[:, 2]
    aside = np.cross(axis, [0.0, 0.0, 1.0])
    count = len(q[::2])
    along = rng.uniform(-0.8, 0.8, (count, 1)) * half * axis
    reach = radius + rng.uniform(0.2, 0.6, (count, 1))
    moved = q.copy()
    moved[::2, :2] = (frame[:3] + along + reach * aside)[:, :2]
    return moved


def beside_a_box(system: System, q: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same for boxes: beside the far face of the first one along x.

    Robots that are not in a plane are otherwise in the first cell.
    """
    (middle, *others), (size, *sizes) = (
        table[1:, :2] for table in (system.obstacle_frame, system.obstacle_size)
    )
    moved, count = q.copy(), len(q[::2])
    places = rng.uniform([0.2, -0.8], [0.6, 0.8], (100 * count, 2))
    places[:, 0] += size[0]
    places[:, 1] *= size[1]
    places += middle
    if not system.torso_floats:  # a robot in a plane
        moved[::2, 0] = places[:count, 0]
        return moved
    away = np.abs(places[:, None] - others) - sizes
    free = (away.max(axis=2) > 1.0).all(axis=1)
    moved[1::2, :2] = np.clip(0.1 * moved[1::2, :2], -0.8, 0.8)
    moved[::2, :2] = places[free][:count]
    return moved


def one_step(system: System) -> Callable[..., tuple[jax.Array, ...]]:
    """The step of one world as a function of arrays: q, v, impulse, normal, fault."""

    def step(
        q: jax.Array,
        v: jax.Array,
        control: jax.Array,
        params: physics.PhysicsParams | None = None,
    ) -> tuple[jax.Array, ...]:
        state = physics.initial_state(system, q, v)
        after, fault = physics.step(system, state, control, params)
        return after.q, after.v, after.impulse, after.normal_impulse, fault

    return step


@functools.cache
def batched_step(system: System) -> Callable[..., tuple[jax.Array, ...]]:
    """The jitted step of a batch of worlds."""
    return jax.jit(jax.vmap(one_step(system)))


_DIFFERENCE = 1e-6  # step of the central differences


@functools.cache
def functional(system: System, steps: int) -> Callable[..., jax.Array]:
    """A random linear functional of everything that some control steps return."""
    rng = np.random.default_rng(1)
    shapes = ((system.nq,), (system.nv,), (system.nb, 6), (system.nb,))
    weights = [rng.normal(size=shape) for shape in shapes]
    step = one_step(system)

    def value(
        q: jax.Array,
        v: jax.Array,
        control: jax.Array,
        params: physics.PhysicsParams | None = None,
    ) -> jax.Array:
        def advance(state: Any, _: None) -> Any:
            *state, impulse, normal, _fault = step(*state, control, params)
            return tuple(state), (impulse, normal)

        state, outputs = jax.lax.scan(advance, (q, v), None, length=steps)
        results = (*state, *(x.sum(axis=0) for x in outputs))
        terms = [(w * x).sum() for w, x in zip(weights, results, strict=True)]
        return jnp.stack(terms).sum()

    return value


def directional_errors(
    value: Callable[..., jax.Array],
    inputs: tuple[np.ndarray, ...],
    distance: float = _DIFFERENCE,
) -> np.ndarray:
    """Errors (inputs, worlds) in units of |gradient| |direction|."""
    rng = np.random.default_rng(2)
    several = jax.jit(jax.vmap(value))
    arguments = tuple(range(len(inputs)))
    gradients = jax.jit(jax.vmap(jax.grad(value, argnums=arguments)))(*inputs)
    errors = []
    for i, gradient in enumerate(gradients):
        direction = rng.normal(size=inputs[i].shape)
        ahead, behind = (
            several(*inputs[:i], inputs[i] + step * direction, *inputs[i + 1 :])
            for step in (distance, -distance)
        )
        difference = np.asarray(ahead - behind) / (2 * distance)
        exact = (np.asarray(gradient) * direction).sum(axis=1)
        size = np.linalg.norm(gradient, axis=1) * np.linalg.norm(direction, axis=1)
        errors.append(np.abs(difference - exact) / size)
    return np.array(errors)


@functools.cache
def rollout(system: System) -> Callable[..., PhysicsState]:
    """A jitted rollout of one world: states (steps, ...) under controls (steps, nu)."""

    def run(q: jax.Array, v: jax.Array, controls: jax.Array) -> PhysicsState:
        def advance(state: PhysicsState, control: jax.Array) -> Any:
            after, _ = physics.step(system, state, control)
            return after, after

        return jax.lax.scan(advance, physics.initial_state(system, q, v), controls)[1]

    return jax.jit(run)


def passive(system: System, steps: int) -> jax.Array:
    """Controls (steps, nu) of zero."""
    return jnp.zeros((steps, system.nu), system.dtype)


@functools.cache
def momentum(system: System) -> Callable[..., tuple[jax.Array, jax.Array]]:
    """Linear momentum (3,), and angular momentum (3,) about the centre of mass."""
    mass = np.asarray(system.mass, system.dtype)[:, None]
    inertia = np.asarray(system.inertia, system.dtype)

    def compute(q: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        bodies = physics.forward_kinematics(system, q, v)
        x, y, z, w = (bodies.rotation[:, i] for i in range(4))
        rows = (
            (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        )
        rotation = jnp.stack([jnp.stack(r, axis=-1) for r in rows], axis=-2)
        world = rotation @ inertia @ rotation.swapaxes(-1, -2)
        spin = (world @ bodies.angular_velocity[:, :, None])[:, :, 0]
        linear = mass * bodies.linear_velocity
        centre = (mass * bodies.com).sum(axis=0) / mass.sum()
        orbit = jnp.cross(bodies.com - centre, linear)
        return linear.sum(axis=0), (orbit + spin).sum(axis=0)

    return jax.jit(compute)


def report(figure: str, value: object) -> None:
    """Prints a measured figure: ``pytest -rP`` shows it."""
    print(f"{figure}: {value}")


def order(steps: np.ndarray, errors: np.ndarray) -> float:
    """Slope of error against step size, both logarithmic."""
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


POINTS = 4097  # of a line along which smoothness is measured
_STRIDES = np.array([1, 2, 4, 8])


def growth(values: np.ndarray) -> float:
    """Order in which second differences (points, ...) along a line shrink."""
    largest = []
    for stride in _STRIDES:
        ahead, here, behind = values[2 * stride :], values[stride:-stride], values
        second = ahead - 2 * here + behind[: len(ahead)]
        largest.append(np.abs(second).max())
    return order(_STRIDES, np.array(largest))


def penetration(gap: Any, width: float) -> np.ndarray:
    """The smooth max(-gap, 0) of the contact law, design in docs/physics.md."""
    u = np.clip(width - gap, 0.0, None)
    inside = u**3 * (3 * width + gap) / (16 * width**3)
    return np.where(gap <= -width, -gap, inside)


def contact_law(
    system: System, h: float, gap: float, vn: float, follows: float = 1.0
) -> tuple[float, float]:
    """Normal impulse [N s] of the implicit law at ``vn``, and its negative slope [kg].

    Args:
        system: The system.
        h: Substep [s].
        gap: Gap at the start of the substep [m].
        vn: Velocity of parting at the end of the substep [m/s].
        follows: 1 if the slope is also that of the dissipation factor, else 0.
    """
    material = system.robot.material
    k = h * system.contact_stiffness
    reach, rate = gap + h * vn, material.dissipation * vn - 1.0
    depth = k * float(penetration(reach, material.smoothing))
    damper = float(penetration(rate, 0.25))
    slope = h * k * _gate(reach, material.smoothing) * damper
    factor = follows * material.dissipation * depth * _gate(rate, 0.25)
    return depth * damper, slope + factor


def _gate(gap: float, width: float) -> float:
    """The slope of ``penetration``, negative."""
    u = np.clip(1.0 - gap / width, 0.0, 2.0)
    return float(0.25 * u**2 * (3.0 - u))


def solved_impulse(
    system: System,
    h: float,
    gap: float,
    vn: float,
    free: float,
    compliance: float,
    solves: int,
) -> float:
    """Normal impulse of one contact after some solves by Newton's method [N s].

    Args:
        system: The system.
        h: Substep [s].
        gap: Gap at the start of the substep [m].
        vn: Velocity of parting at the start [m/s].
        free: Its change without the contact [m/s].
        compliance: Its change per unit of impulse [1/kg].
        solves: Solves; the first starts from ``vn``.
    """
    at, impulse = vn, 0.0
    for _ in range(solves):
        law, weight = contact_law(system, h, gap, at)
        # law - weight (new - at), where new = vn + free + compliance * impulse
        impulse = (law + weight * (at - vn - free)) / (1.0 + weight * compliance)
        at = vn + free + compliance * impulse
    return impulse


def nearest(at: np.ndarray, along: np.ndarray, half: float) -> np.ndarray:
    """Distances (n,) of segments from a segment on the z axis, by brute force."""
    share = np.linspace(-1.0, 1.0, 801)[:, None]
    points = at[:, None] + share * along[:, None]
    beyond = points[..., 2] - np.clip(points[..., 2], -half, half)
    flat = np.concatenate([points[..., :2], beyond[..., None]], axis=-1)
    return np.linalg.norm(flat, axis=-1).min(axis=1)


BOX_MASS = 4.0  # [kg]
BOX_HEIGHT = 0.07  # of its centre when its spheres just touch [m]
_RADIUS = 0.02  # of its corner spheres [m]
_BOX = f"""<robot name="box"><link name="box">
  <inertial><mass value="{BOX_MASS}"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><geometry><sphere radius="{_RADIUS}"/></geometry></collision>
</link></robot>"""


def box_system(folder: Path, angle: float, **material: Any) -> System:
    """A free box on four corner spheres, on a plane that descends along x.

    Args:
        folder: Where to write the URDF file.
        angle: Slope of the plane [rad].
        **material: Changes of the default material.
    """
    robot = row(
        write(folder, _BOX),
        "box",
        contacts=(Contact("box"),),
        dt=0.01,
        substeps=1,
        material=Material(**material),
    )
    system = build_system(robot, "float64")
    down = _RADIUS - BOX_HEIGHT
    corners = [[x, y, down] for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    tilt = reference.axis_quaternion(np.array([0.0, 1.0, 0.0]), angle)
    return dataclasses.replace(
        system,
        contact_body=np.zeros(4, np.int32),
        contact_obstacle=np.zeros(4, np.int32),
        contact_position=np.array(corners),
        contact_segment=np.zeros((4, 3)),
        contact_radius=np.full(4, _RADIUS),
        obstacle_frame=np.concatenate([np.zeros(3), tilt])[None],
    )


def resting_gap(system: System, gravity: float) -> float:
    """Gap at which the contacts carry the weight, found by bisection [m]."""
    carried = system.total_mass * gravity / len(system.contact_body)
    deep = carried / system.contact_stiffness
    width = system.robot.material.smoothing
    low, high = -max(deep, width), width
    for _ in range(60):
        middle = 0.5 * (low + high)
        if penetration(middle, width) > deep:
            low = middle
        else:
            high = middle
    return low


def single_states(worlds: int, seed: int = 0) -> tuple[System, Arrays]:
    """The ant in float32 with random states."""
    system = physics.load_system(ROBOTS["ant"])
    states = random_states(system, np.random.default_rng(seed), worlds)
    return system, tuple(x.astype(np.float32) for x in states)


def outputs(system: System, states: Arrays) -> Arrays:
    return tuple(np.asarray(x) for x in batched_step(system)(*states))
