"""Measures nearest points with a kernel of the geometry alone, and its adjoint."""

from __future__ import annotations

import functools
import importlib
import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from unoptimized import leave_unoptimized

from newton_qd.physics.buffers import build_model
from newton_qd.physics.precision import Variant, build_kernels
from newton_qd.physics.system import System

PACK = 4  # worlds of a pack in float64 on a CPU

_KERNEL = """
import warp as wp

@wp.kernel
def measure(m: MODEL, c: int, o: int, at: wp.array(dtype=VEC3),
            along: wp.array(dtype=VEC3), y: wp.array(dtype=REAL)):
    i = wp.tid()
    s = nearest_share(m, c, o, at[i], along[i])
    touch = at[i] + s * along[i]
    n = obstacle_normal(m, o, touch)
    y[5 * i] = s
    y[5 * i + 1] = obstacle_distance(m, o, touch)
    y[5 * i + 2] = component(n, 0)
    y[5 * i + 3] = component(n, 1)
    y[5 * i + 4] = component(n, 2)
"""


@functools.cache
def measuring(folder: Path, boxes: bool) -> Any:
    """A kernel of the geometry alone."""
    space = build_kernels(Variant("float64", PACK, boxes=boxes))
    package = space.package
    nearest = importlib.import_module(f"{package.__name__}.nearest")
    path = folder / "measure.py"
    path.write_text(_KERNEL)
    spec = importlib.util.spec_from_file_location("measure", path)
    assert spec is not None and spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    module.MODEL, module.VEC3 = space.structs.Model, package.vec3
    module.REAL = package.real
    for name in ("nearest_share", "obstacle_normal", "obstacle_distance"):
        setattr(module, name, getattr(nearest, name))
    for name in ("add", "mul", "component"):
        setattr(module, name, getattr(nearest, name, None) or nearest.mul)
    spec.loader.exec_module(module)
    leave_unoptimized(module)
    return module.measure


def packed(values: np.ndarray, kind: Any) -> Any:
    """Vectors (n, 3) as packs on the CPU."""
    packs = values.reshape(-1, PACK, 3).swapaxes(1, 2)
    return wp.array(packs, dtype=kind, device="cpu", requires_grad=True)


class Measured:
    """Shares (n,), distances (n,) and normals (n, 3), and their adjoints."""

    def __init__(
        self, folder: Path, system: System, contact: int, at: Any, along: Any
    ) -> None:
        kernel = measuring(folder, system.has_boxes)
        package = build_kernels(
            Variant("float64", PACK, boxes=system.has_boxes)
        ).package
        held = [packed(at, package.vec3), packed(along, package.vec3)]
        packs = len(at) // PACK
        y = wp.zeros(5 * packs, dtype=package.real, device="cpu", requires_grad=True)
        model = build_model(system, wp.get_device("cpu"))
        obstacle = int(system.contact_obstacle[contact])
        inputs = [model, contact, obstacle, *held, y]
        wp.launch(kernel, packs, inputs, device="cpu")
        rows = y.numpy().reshape(packs, 5, PACK).swapaxes(1, 2).reshape(-1, 5)
        self.share, self.distance, self.normal = rows[:, 0], rows[:, 1], rows[:, 2:]
        y.grad.fill_(1.0)
        unused: list[Any] = [model, *[None] * (len(inputs) - 1)]
        wp.launch(kernel, packs, inputs, adj_inputs=unused, adjoint=True, device="cpu")
        self.slopes = np.stack([x.grad.numpy() for x in held])
