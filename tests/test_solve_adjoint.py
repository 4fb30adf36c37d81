"""The adjoint of a linear solve, by hand, against differences of the solve itself.

The solve alone, of trees with a free root and without, with contacts and pairs, at
inertias, axes and weights that are random: nothing about them is special, and no other
stage hides an error.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import warp as wp
from coupled_bodies import coupled_system
from hexapod import hexapod
from physics_helpers import report
from unoptimized import leave_unoptimized

from newton_qd.physics import buffers
from newton_qd.physics.model import build_system
from newton_qd.physics.system import System

KERNEL = """
import warp as wp
from {package}.cpp.place import place
from {package}.solve import solve
from {package}.structs import Model, Scratch, offsets_at

@wp.kernel
def solve_once(m: Model, sc: Scratch):
    solve(m, place(sc, wp.tid()), offsets_at(m, 0, 1, 0, 0), 0, 1)
"""
FOUND = ("slip", "dv")
# what the changes are linear in: differences have no other error than rounding
LINEAR = ("push", "joint_push", "wrench_w", "wrench_v")
OTHERS = ("inertia", "moment", "parameter", "joint_weight", "axis_w", "axis_v", "pose")
OTHERS += ("point", "normal", "weight_n", "weight_t")
STEP = 2e-4


def system_of(name: str, folder: Path) -> System:
    if name == "hexapod":
        return build_system(hexapod(folder, damping=0.1), "float64")
    return coupled_system(folder, free=name == "free root with pairs")


class Solve:
    """A solve whose inputs are random, in one pack of worlds that all differ."""

    def __init__(self, system: System, folder: Path) -> None:
        """Fills the scratch."""
        self.system = system
        device = wp.get_device("cpu")
        kernels = buffers.kernels_of(system, device, parametric=True)
        self.model = buffers.build_model(system, device, parametric=True)
        memory = buffers.build_scratch(system, 1, device, adjoint=True, parametric=True)
        self.memory, self.structs = memory, kernels.structs
        path = folder / "solve_once.py"
        path.write_text(KERNEL.format(package=kernels.package.__name__))
        spec = importlib.util.spec_from_file_location(path.stem, path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        leave_unoptimized(module)
        self.kernel = module.solve_once
        self.fill(np.random.default_rng(0))

    def array(self, name: str) -> np.ndarray:
        """Values (n, components, worlds) of an array, to be changed."""
        return self.memory.array(name)

    def used(self, name: str) -> slice:
        """Entries of an array that the solve may reach."""
        nb, nv, nc = self.system.nb, self.system.nv, len(self.system.contact_body)
        bodies, dofs, contacts = slice(1, nb + 1), slice(nv), slice(nc)
        if name in ("axis_w", "axis_v", "dv", "joint_push", "joint_weight"):
            return dofs
        if name in ("slip", "push", "point", "normal", "weight_n", "weight_t"):
            return contacts
        if name == "parameter":
            start = self.model.parameters.mass
            return slice(start, start + nb)
        return bodies

    def fill(self, rng: np.random.Generator) -> None:
        """Random inertias about the origin, places, axes, contacts and impulses."""
        for name in (*LINEAR, *OTHERS):
            array, used = self.array(name), self.used(name)
            array[used] = rng.normal(size=array[used].shape)
        mass = self.array("parameter")[self.used("parameter")]
        mass[:] = rng.uniform(0.5, 2.0, mass.shape)
        for name in ("weight_n", "weight_t", "joint_weight"):
            weights = self.array(name)
            weights[:] = rng.uniform(0.1, 1.0, weights.shape)
        # a mass at each of four points
        at = 0.5 * rng.normal(size=(4, self.system.nb, 3, mass.shape[-1]))
        self.array("moment")[1 : self.system.nb + 1] = 0.25 * mass * at.sum(axis=0)
        about = np.einsum("pbkw,pbkw,ij->bijw", at, at, np.eye(3))
        about = 0.25 * mass[:, None] * (about - np.einsum("pbiw,pbjw->bijw", at, at))
        upper = np.triu_indices(3)
        self.array("inertia")[1 : self.system.nb + 1] = about[:, upper[0], upper[1]]
        self.array("load")[:] = 1.0

    def launch(self, adjoint: bool = False) -> None:
        """Runs the solve, or its adjoint."""
        unused = [self.structs.Model(), self.structs.Scratch()]
        wp.launch(
            self.kernel,
            dim=1,
            inputs=[self.model, self.memory.values],
            adj_inputs=unused if adjoint else [],
            adjoint=adjoint,
            device="cpu",
            block_dim=1,
        )

    def value(self, weights: dict[str, np.ndarray]) -> np.ndarray:
        """Weighted sum (worlds,) of the changes that the solve finds."""
        self.launch()
        found = [weights[name] * self.array(name)[self.used(name)] for name in FOUND]
        return np.sum([part.sum(axis=(0, 1)) for part in found], axis=0)

    def slope(self, entry: np.ndarray, step: float, weights: Any) -> np.ndarray:
        """Difference quotient (worlds,), of fourth order, for one number."""
        kept, total = entry.copy(), np.zeros(entry.shape)
        for distance, share in ((1, 2 / 3), (-1, -2 / 3), (2, -1 / 12), (-2, 1 / 12)):
            entry[:] = kept + distance * step
            total += share / step * self.value(weights)
        entry[:] = kept
        return total


@pytest.mark.parametrize(
    "name",
    [
        "hexapod",
        pytest.param("free root with pairs", marks=pytest.mark.slow),
        pytest.param("slides and pairs", marks=pytest.mark.slow),
    ],
)
def test_every_input_of_a_solve(x64: None, tmp_path: Path, name: str) -> None:
    """To each number of each input; adjoints of the changes are 0 afterwards."""
    solve = Solve(system_of(name, tmp_path), tmp_path)
    rng = np.random.default_rng(1)
    weights = {}
    for part in FOUND:
        adjoint = solve.memory.array(part, adjoint=True)[solve.used(part)]
        weights[part] = adjoint[:] = rng.normal(size=adjoint.shape)
    # the adjoint of a plain function does not repeat it
    solve.launch()
    solve.launch(adjoint=True)
    for part in FOUND:
        assert not solve.memory.array(part, adjoint=True).any()
    worst = {}
    for part in (*LINEAR, *OTHERS):
        found = solve.memory.array(part, adjoint=True).copy()
        values, used = solve.array(part), solve.used(part)
        step = 1.0 if part in LINEAR else STEP
        expected = np.zeros(found.shape)
        for entry in range(*used.indices(len(values))):
            for n in range(values.shape[1]):
                expected[entry, n] = solve.slope(values[entry, n], step, weights)
        scale = np.abs(expected).max()
        if part != "pose" or name != "slides and pairs":
            assert scale > 0, part
        worst[part] = np.abs(found - expected).max() / max(scale, 1.0)
    report(f"{name}: largest errors", worst)
    assert max(worst[part] for part in LINEAR) < 1e-11
    assert max(worst.values()) < 1e-7
