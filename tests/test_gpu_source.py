"""Kernels compile for a GPU, also on a machine that has none.

The CUDA of a kernel is other code than its C++ (one world in a pack, barriers, lanes),
and tests on a CPU do not see it. Warp's compiler makes PTX of it without a driver. The
assembler of the driver is not run.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import pytest
import warp as wp

from newton_qd.physics.launch import MODULES
from newton_qd.physics.precision import Variant, build_kernels

COMPUTE_CAPABILITY = 90
PLAIN = Variant("float32", 1)
EVERYTHING = dataclasses.replace(PLAIN, parametric=True, boxes=True, pairs=True)
# one kernel shows that the compiler works; all of them take a minute
QUICK = "bodies_forward"


def case(variant: Variant, name: str) -> Any:
    """The parameters of a test, marked as slow where they are."""
    marks = [] if name == QUICK else [pytest.mark.slow]
    features = variant.package.split("kernels_")[1]
    return pytest.param(variant, name, marks=marks, id=f"{features}-{name}")


@pytest.mark.skipif(sys.platform == "darwin", reason="Warp for macOS has no CUDA")
@pytest.mark.parametrize(
    ("variant", "name"),
    [
        *(case(PLAIN, name) for name in MODULES),
        # their geometry, and everything with its adjoint
        case(EVERYTHING, "contact_gaps"),
        case(EVERYTHING, "step_backward"),
    ],
)
def test_a_kernel_compiles_for_a_gpu(
    variant: Variant, name: str, tmp_path: Path
) -> None:
    """It is alone in its module, and has an adjoint if it is launched backwards."""
    module = getattr(build_kernels(variant), MODULES[name])
    wp.compile_aot_module(
        module, arch=COMPUTE_CAPABILITY, module_dir=tmp_path, use_ptx=True
    )
    (program,) = tmp_path.glob("*.ptx")
    lines = program.read_text(encoding="utf-8").splitlines()
    entries = [line for line in lines if ".entry" in line]
    directions = ["forward", "backward"] if name.endswith("_backward") else ["forward"]
    assert len(entries) == len(directions)
    for direction, entry in zip(directions, sorted(entries, reverse=True), strict=True):
        assert f" {name}_" in entry
        assert f"_cuda_kernel_{direction}" in entry
