"""Every kernel compiles for a GPU, also on a machine that has none.

The CUDA of a kernel is other code than its C++ (one world in a pack, barriers, lanes),
and tests on a CPU do not see it. Warp's compiler for GPUs needs no driver.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import pytest
import warp as wp

from newton_qd.physics.launch import MODULES
from newton_qd.physics.precision import Variant, build_kernels

COMPUTE_CAPABILITY = 90
PLAIN = Variant("float32", 1)
CASES = [(PLAIN, name) for name in MODULES if name != "contact_impulses"]
# the features, each in the kernel that has most of its code
CASES += [
    (dataclasses.replace(PLAIN, boxes=True, pairs=True), "contact_gaps"),
    (dataclasses.replace(PLAIN, parametric=True), "step_forward"),
]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "darwin", reason="Warp for macOS has no CUDA")
@pytest.mark.parametrize(
    ("variant", "name"),
    CASES,
    ids=[f"{variant.package.split('kernels_')[1]}-{name}" for variant, name in CASES],
)
def test_a_kernel_compiles_for_a_gpu(
    variant: Variant, name: str, tmp_path: Path
) -> None:
    module = getattr(build_kernels(variant), MODULES[name])
    wp.compile_aot_module(
        module, arch=COMPUTE_CAPABILITY, module_dir=tmp_path, use_ptx=True
    )
    (program,) = tmp_path.glob("*.ptx")
    text = program.read_text(encoding="utf-8")
    entries = [line for line in text.splitlines() if ".entry" in line]
    assert any(name in entry for entry in entries)
    # only what is launched backwards has an adjoint
    has_adjoint = any("_cuda_kernel_backward" in entry for entry in entries)
    assert has_adjoint == name.endswith("_backward")
