"""Speed of Newton's own solvers with the robots of this project, on one GPU.

    python benchmarks/newton_solvers.py [--robots ant ...] [--batches 4096 ...]
        [--solvers mujoco semi_implicit] [--out FILE.csv]

Only the physics runs: the robot's URDF file on a plane, with random torques that are
set once, in a CUDA graph of one control step. There is no observation, no reward and no
reset, so the figures are upper bounds of an environment's. The MuJoCo solver has the
substeps of our robot, SemiImplicit as many as ``--fine`` says: it is explicit, and
diverges with longer ones. A row counts if the coordinates are finite in the end.

SolverMuJoCo needs `pip install 'mujoco~=3.17.0' 'mujoco-warp~=3.17.0'`.
"""

from __future__ import annotations

import argparse
import csv
import functools
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import newton
import numpy as np
import warp as wp

import newton_qd

ROBOTS = ("ant", "halfcheetah", "hopper", "walker2d", "humanoid")
URDF = Path(__file__).resolve().parents[1] / "urdf"
FREE = ("ant", "humanoid")
CONTROL_STEPS = 32
TORQUE = 1.0  # [N m]
HEIGHT = 1.4  # of a free root at the start [m]


def scene(robot: str, worlds: int) -> Any:
    """Returns the worlds of a robot, as a model of Newton."""
    one = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(one)
    transform = wp.transform((0.0, 0.0, HEIGHT if robot in FREE else 0.0), (0, 0, 0, 1))
    one.add_urdf(
        str(URDF / f"{robot}.urdf"),
        xform=transform,
        floating=robot in FREE,
        enable_self_collisions=False,
    )
    whole = newton.ModelBuilder()
    whole.replicate(one, worlds)
    whole.add_ground_plane()
    return whole.finalize()


def mujoco(model: Any) -> Any:
    """Returns MuJoCo Warp as Newton has it."""
    return newton.solvers.SolverMuJoCo(model, njmax=100, nconmax=50)


def semi_implicit(model: Any) -> Any:
    """Returns Newton's semi-implicit Euler scheme in maximal coordinates."""
    return newton.solvers.SolverSemiImplicit(model)


SOLVERS: dict[str, Callable[[Any], Any]] = {
    "mujoco": mujoco,
    "semi_implicit": semi_implicit,
}


def measure(
    robot: str, name: str, worlds: int, fine: int, repetitions: int
) -> tuple[float, bool]:
    """Million control steps per second, and whether the coordinates are finite."""
    system: Any = newton_qd.create(robot).unwrapped
    system = system.system
    model = scene(robot, worlds)
    solver = SOLVERS[name](model)
    control = model.control()
    forces = np.random.default_rng(0).uniform(-TORQUE, TORQUE, control.joint_f.shape)
    control.joint_f.assign(forces.astype(np.float32))
    states = [model.state(), model.state()]
    newton.eval_fk(model, model.joint_q, model.joint_qd, states[0])
    substeps = system.substeps if name == "mujoco" else fine
    substeps += substeps % 2  # the states end where they began
    dt = system.h * system.substeps / substeps
    collides = name != "mujoco"
    contacts = model.contacts() if collides else None

    def control_step() -> None:
        for n in range(substeps):
            before, after = states[n % 2], states[1 - n % 2]
            before.clear_forces()
            if collides:
                model.collide(before, contacts)
            solver.step(before, after, control, contacts, dt)

    control_step()
    if model.device.is_cuda:
        with wp.ScopedCapture() as capture:
            control_step()
        graph = capture.graph
        assert graph is not None  # the capture is over
        run = functools.partial(wp.capture_launch, graph)
    else:
        run = control_step
    times = []
    for _ in range(repetitions):
        wp.synchronize()
        start = time.perf_counter()
        for _ in range(CONTROL_STEPS):
            run()
        wp.synchronize()
        times.append(time.perf_counter() - start)
    finite = np.isfinite(states[0].body_q.numpy()).all()
    return worlds * CONTROL_STEPS / statistics.median(times) / 1e6, bool(finite)


def main() -> None:
    """Print a row for each robot, solver and batch."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=ROBOTS)
    parser.add_argument("--batches", nargs="+", type=int, default=[4096])
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=list(SOLVERS))
    parser.add_argument("--fine", type=int, default=50, help="explicit substeps")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--out", type=Path, help="csv file for the rows")
    options = parser.parse_args()
    columns = ("robot", "solver", "worlds", "million steps/s", "note")
    print(
        f"{wp.get_device().name}\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}"
    )
    rows = []
    for robot in options.robots:
        for name in options.solvers:
            for worlds in options.batches:
                row: tuple[Any, ...] = (robot, name, worlds)
                try:
                    rate, finite = measure(
                        robot, name, worlds, options.fine, options.repetitions
                    )
                    row += (f"{rate:.3g}", "" if finite else "not finite")
                # a solver may not load a robot, and the others still count
                except Exception as error:
                    row += ("", f"{type(error).__name__}: {error}"[:90])
                rows.append(row)
                print("| " + " | ".join(map(str, row)) + " |", flush=True)
    if options.out is not None:
        with options.out.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([columns, *rows])


if __name__ == "__main__":
    main()
