"""The speed up to which walls hold: nothing passes below it, and it is not too low."""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from physics_helpers import passive, report, rollout
from urdf_text import joint, row, sphere, write

from newton_qd import physics, robots
from newton_qd.physics import reference
from newton_qd.physics.model import build_system, wall_speeds
from newton_qd.physics.stepping import substep_solves
from newton_qd.physics.system import System
from newton_qd.robots import ANT, HUMANOID, WALKER2D, Contact, Material
from newton_qd.scenes import (
    ANTMAZE_HARDEST,
    HUMANOID_MAZE,
    HUMANOID_TRAP,
    HURDLES,
    MAZE,
    TRAP,
    Scene,
)

HIGH = 5.0  # height of walls that nothing leads around [m]
SHOTS = 64


@dataclasses.dataclass(frozen=True)
class Shot:
    """A body that flies along x at a wall whose middle is at x = 0.

    Attributes:
        wall: ``"box"`` or ``"capsule"``.
        thick: From the middle to the surface [m].
        radius: Of the body [m].
        half: Half length of a capsule [m]; 0: a ball.
        lie: Direction of the capsule: ``"any"``, or ``"along"`` the wall.
        mass: Of the body [kg].
        height: Of the middle of the wall [m].
        glancing: Largest angle to the normal of the wall [rad].
        material: What differs from the default material.
        rotor: Whether a light undamped rotor is in it, so that its substeps have three
            iterations.
    """

    wall: str
    thick: float
    radius: float
    half: float = 0.0
    lie: str = "any"
    mass: float = 1.0
    height: float = HIGH
    glancing: float = 0.0
    material: tuple[tuple[str, Any], ...] = ()
    rotor: bool = False

    @property
    def rolls(self) -> bool:
        """Whether the body is on the ground, and the wall too."""
        return self.height < HIGH


ROTOR = """<link name="rotor"><inertial><mass value="1e-3"/><inertia ixx="1e-5"
    iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="spin" type="continuous"><parent link="body"/><child link="rotor"/>
    <axis xyz="0 1 0"/></joint>"""


def scene(folder: Path, shot: Shot) -> Scene:
    shape = f"<box size='{2 * shot.thick} 40 8'/>"
    if shot.wall == "capsule":
        shape = f"<capsule radius='{shot.thick}' height='40'/>"
    turn = "1.5707963267948966 0 0" if shot.wall == "capsule" else "0 0 0"
    path = folder / "wall.urdf"
    path.write_text(
        f"""<robot name="wall"><link name="wall"><collision>
        <origin xyz="0 0 {shot.height}" rpy="{turn}"/><geometry>{shape}</geometry>
        </collision></link></robot>"""
    )
    return Scene("wall", str(path))


def system_of(folder: Path, shot: Shot, h: float) -> System:
    shape = f"<sphere radius='{shot.radius}'/>"
    if shot.half:
        shape = f"<capsule radius='{shot.radius}' height='{2 * shot.half}'/>"
    inertia = 0.02 * shot.mass
    text = f"""<robot name="body"><link name="body"><inertial>
    <mass value="{shot.mass}"/><inertia ixx="{inertia}" iyy="{inertia}"
    izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry>{shape}</geometry></collision></link>
    {ROTOR if shot.rotor else ""}</robot>"""
    ends = (Contact("body", 1), Contact("body", -1))
    spec = row(
        write(folder, text),
        "body",
        contacts=ends if shot.half else (Contact("body"),),
        dt=h,
        substeps=1,
        gravity=9.81 if shot.rolls else 0.0,
        material=Material(**dict(shot.material)),
    )
    return build_system(spec, "float32", scene(folder, shot))


def passed(system: System, shot: Shot, speed: float) -> float:
    """Share of shots at a speed that get past the middle of the wall."""
    rng = np.random.default_rng(0)
    h = system.robot.dt
    across = np.cos(rng.uniform(-shot.glancing, shot.glancing, SHOTS))
    q, v = np.zeros((SHOTS, system.nq)), np.zeros((SHOTS, system.nv))
    v[:, 0], v[:, 1] = speed * across, speed * np.sqrt(1 - across**2)
    # the first touch is anywhere in a substep
    apart = shot.thick + shot.radius + shot.half + 0.03
    q[:, 0] = -apart - speed * h * rng.uniform(0, 1, SHOTS)
    q[:, 2] = shot.radius if shot.rolls else HIGH
    q[:, 6] = 1.0
    if shot.half:
        axes = rng.normal(size=(SHOTS, 3))
        if shot.lie == "along":
            axes[:, 0] *= 1e-3
            axes[:, 2] *= 1e-3
        for k, axis in enumerate(axes / np.linalg.norm(axes, axis=1)[:, None]):
            turn = np.cross([0.0, 0.0, 1.0], axis)
            size = float(np.linalg.norm(turn))
            angle = np.arctan2(size, axis[2])
            q[k, 3:7] = reference.axis_quaternion(turn / size, angle)
    steps = int(max(0.3, 3 * apart / speed) / h)
    return float((path_of(system, q, v, steps)[..., 0] > 0).any(axis=1).mean())


def path_of(system: System, q: np.ndarray, v: np.ndarray, steps: int) -> np.ndarray:
    """Coordinates (n, t, nq) of worlds without actions."""

    def run(q: jax.Array, v: jax.Array) -> jax.Array:
        return rollout(system)(q, v, passive(system, steps)).q

    path = jax.jit(jax.vmap(run))(q.astype(np.float32), v.astype(np.float32))
    assert np.isfinite(path).all()
    return np.asarray(path, np.float64)


BOX = Shot("box", 0.1, 0.03)
CAPSULE = Shot("capsule", 0.1, 0.03)
SPUN = dataclasses.replace(BOX, rotor=True)
ROD = Shot("box", 0.05, 0.03, half=0.2)
SOFT = (("static_penetration", 0.01), ("dissipation", 0.0))
STIFF = (("static_penetration", 0.001), ("support", 2))
SHOOT = {
    "ball, box": BOX,
    "ball, box, glancing": dataclasses.replace(BOX, glancing=1.4),
    "ball, box, light": dataclasses.replace(BOX, mass=0.02),
    "ball, box, heavy": dataclasses.replace(BOX, mass=50.0),
    "ball, box, soft": dataclasses.replace(BOX, material=SOFT),
    "ball, thin box": dataclasses.replace(BOX, thick=0.01),
    "ball, thin box, stiff": dataclasses.replace(BOX, thick=0.01, material=STIFF),
    "ball, capsule": CAPSULE,
    "ball, capsule, glancing": dataclasses.replace(CAPSULE, glancing=1.4),
    "ball, thin capsule": dataclasses.replace(CAPSULE, thick=0.02, radius=0.05),
    "rod, box": ROD,
    "rod, box, along": dataclasses.replace(ROD, lie="along"),
    "rod, box, soft": dataclasses.replace(ROD, material=SOFT),
    "rod, capsule, along": dataclasses.replace(
        ROD, wall="capsule", thick=0.1, lie="along"
    ),
    "ball, under a capsule": dataclasses.replace(CAPSULE, height=0.1),
    "ball, under a large capsule": Shot("capsule", 0.5, 0.08, height=0.5),
    "ball, under a smooth capsule": dataclasses.replace(
        CAPSULE, height=0.1, material=(("friction", 0.0),)
    ),
    "ball with a rotor, box": SPUN,
    "ball with a rotor, box, soft": dataclasses.replace(SPUN, material=SOFT),
    "ball with a rotor, thin box, stiff": dataclasses.replace(
        SPUN, thick=0.01, material=STIFF
    ),
    "ball with a rotor, capsule": dataclasses.replace(CAPSULE, rotor=True),
    "ball with a rotor, under a capsule": dataclasses.replace(
        CAPSULE, height=0.1, rotor=True
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("h", [0.002, 0.005, 0.01, 0.02])
@pytest.mark.parametrize("name", SHOOT)
def test_nothing_passes_below_the_speed(tmp_path: Path, name: str, h: float) -> None:
    """Up to 0.9 of it nothing does; at twice the speed, something does.

    The latter holds for substeps up to 5 ms. Longer ones hold more than the contact.
    """
    shot = SHOOT[name]
    system = system_of(tmp_path, shot, h)
    walls = system.contact_obstacle > 0
    limit = float(physics.wall_speeds(system)[walls].min())
    assert 0.0 < limit <= 100.0
    shares = [passed(system, shot, share * limit) for share in (0.3, 0.6, 0.9)]
    beyond = [passed(system, shot, share * limit) for share in (1.2, 1.6, 2.0)]
    report("speed [m/s], shares that pass", (limit, shares, beyond))
    assert shares == [0.0, 0.0, 0.0]
    if limit < 30.0 and h <= 0.005:
        assert max(beyond) > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [1.0, 10.0, 100.0])
def test_heavy_robot_with_a_light_link(tmp_path: Path, ratio: float) -> None:
    """The wall stops a ball that hangs on a heavier body beside the wall."""
    arm = 0.3

    def heavy(name: str, mass: float, inside: str = "") -> str:
        inertia = 0.02 * mass
        return f"""<link name="{name}"><inertial><mass value="{mass}"/><inertia
        ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/>
        </inertial>{inside}</link>"""

    hinge = f'<origin xyz="0 0 {-arm}"/><axis xyz="0 1 0"/>'
    text = f"""<robot name="two">{heavy("top", ratio)}
    {joint("hinge", "continuous", "top", "ball", hinge)}
    {heavy("ball", 1.0, sphere(BOX.radius, "0 0 -0.2"))}</robot>"""
    spec = row(
        write(tmp_path, text), "top", contacts=(Contact("ball"),), dt=0.005, substeps=1
    )
    spec = dataclasses.replace(spec, gravity=0.0)
    system = build_system(spec, "float32", scene(tmp_path, BOX))
    limit = float(physics.wall_speeds(system)[-1])
    q, v = np.zeros((16, system.nq)), np.zeros((16, system.nv))
    v[:, 0] = 0.9 * limit
    q[:, 0] = -0.2 - 0.9 * limit * 0.005 * np.linspace(0, 1, 16, endpoint=False)
    q[:, 2], q[:, 6] = HIGH, 1.0
    path = path_of(system, q, v, 60)
    far = max(
        reference.compose(frame[1], np.array([0, 0, -0.2, 0, 0, 0, 1.0]))[0]
        for frame in (reference.body_frames(system, x) for x in path.reshape(-1, 8))
    )
    report("speed [m/s], how far the ball gets [m]", (limit, far))
    assert far < 0.0


@pytest.mark.slow
@pytest.mark.parametrize("shot", [SPUN, dataclasses.replace(SPUN, glancing=1.4)])
def test_several_iterations_hold_what_is_promised(tmp_path: Path, shot: Shot) -> None:
    """The damping factor follows the velocity, so long substeps hold less."""
    one = system_of(tmp_path, BOX, 0.01)
    several = system_of(tmp_path, shot, 0.01)
    assert substep_solves(one).iterations == 1 < substep_solves(several).iterations
    limits = [float(physics.wall_speeds(s)[-1]) for s in (one, several)]
    shares = [passed(several, shot, share * limits[1]) for share in (0.5, 0.9, 1.0)]
    report("speeds that are held, shares that pass", (limits, shares))
    assert shares == [0.0, 0.0, 0.0]
    assert limits[1] < 0.8 * limits[0]


@pytest.mark.slow
@pytest.mark.parametrize("speed", [7.5, 10.0])
def test_ball_of_3_cm_and_box_of_20_cm(tmp_path: Path, speed: float) -> None:
    """The contact is soft: shorter substeps hold less, and stiffer material more."""
    shares, limits = [], []
    for h, material in ((0.01, ()), (0.001, ()), (0.001, STIFF)):
        shot = dataclasses.replace(BOX, material=material)
        system = system_of(tmp_path, shot, h)
        limits.append(float(physics.wall_speeds(system)[-1]))
        shares.append(passed(system, shot, speed))
    report("speeds that are held, shares that pass", (limits, shares))
    assert shares == [0.0, 1.0, 0.0]
    assert limits[0] > 10.0 and limits[1] < 7.5 and limits[2] > 10.0


def test_arm_has_to_be_stopped_too(tmp_path: Path) -> None:
    """A ball near the hinge of an arm stops more than the mass of the arm."""
    limits = []
    for inertia in (0.1, 4.0):
        text = f"""<robot name="arm"><link name="world"/>
        {joint("hinge", "continuous", "world", "arm", '<axis xyz="0 0 1"/>')}
        <link name="arm"><inertial><mass value="1"/><inertia ixx="4" iyy="4"
        izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial>
        {sphere(0.03, "0.5 0 0")}</link></robot>"""
        spec = row(write(tmp_path, text), "arm", contacts=(Contact("arm"),))
        system = build_system(spec, "float32", scene(tmp_path, CAPSULE))
        limits.append(float(physics.wall_speeds(system)[-1]))
    # 4 kg m^2 at 0.5 m is as 16 kg
    assert limits[1] < 0.5 * limits[0]


def test_ground_and_pairs_hold_all_speeds(tmp_path: Path) -> None:
    system = system_of(tmp_path, BOX, 0.01)
    speeds = physics.wall_speeds(system)
    assert np.isinf(speeds[system.contact_obstacle <= 0]).all()
    pairs = build_system(robots.HALFCHEETAH, "float32")
    assert np.isinf(physics.wall_speeds(pairs)).all()


def test_walls_of_the_suite_hold() -> None:
    for robot, place in (
        (ANT, TRAP),
        (ANT, MAZE),
        (HUMANOID, HUMANOID_TRAP),
        (ANT, ANTMAZE_HARDEST),
        (HUMANOID, HUMANOID_MAZE),
        (WALKER2D, HURDLES),
    ):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            system = physics.load_system(robot, "float32", place)
        speeds = physics.wall_speeds(system)
        report(f"{robot.name} in {place.name}", np.unique(np.round(speeds, 1)))
        for wall in range(1, len(system.obstacle_kind)):
            assert speeds[system.contact_obstacle == wall].max() > 20.0


def test_the_link_that_a_wall_holds_best_counts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The other links stay with it."""
    system = build_system(ANT, "float32", TRAP)
    speeds = np.where(system.contact_obstacle > 0, 1.0, np.inf)
    monkeypatch.setattr(wall_speeds, "wall_speeds", lambda system: speeds)
    walls = range(1, len(system.obstacle_kind))
    assert len(wall_speeds.soft_walls(system)) == len(walls) == 3
    for wall in walls:
        speeds[np.flatnonzero(system.contact_obstacle == wall)[-1]] = 20.0
    assert wall_speeds.soft_walls(system) == ()


def test_soft_wall_gives_a_warning(tmp_path: Path) -> None:
    shot = dataclasses.replace(BOX, thick=0.01)
    soft, firm = (
        dataclasses.replace(system_of(tmp_path, shot, 0.01).robot, material=material)
        for material in (Material(), Material(static_penetration=1e-5))
    )
    place = scene(tmp_path, shot)
    expected = r"scene 'wall', wall 1: got test is held up to 1.5 m/s; allowed: 10"
    with pytest.warns(physics.SoftWallWarning, match=expected):
        physics.load_system(soft, "float32", place)
    for robot, walls in ((firm, place), (soft, None)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            physics.load_system(robot, "float32", walls)


def test_stiffness_that_a_warning_asks_for(tmp_path: Path) -> None:
    """A smaller penetration at rest and a thicker wall both hold more."""

    def limit(**changes: Any) -> float:
        system = system_of(tmp_path, dataclasses.replace(BOX, **changes), 0.005)
        return float(physics.wall_speeds(system)[-1])

    held = [limit(material=(("static_penetration", x),)) for x in (0.01, 0.003, 0.001)]
    assert (np.diff(held) > 0).all()
    held = [limit(thick=x) for x in (0.01, 0.03, 0.1)]
    assert (np.diff(held) > 0).all()
