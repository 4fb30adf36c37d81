"""Launches of the step's kernels on Warp arrays: threads on a CPU, lanes on a GPU."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

from newton_qd.physics import buffers
from newton_qd.physics.precision import kernels
from newton_qd.physics.system import System

LANES = (1, 2, 4, 8, 16, 32)
_BLOCK = 128
_MIN_WORLDS_PER_THREAD = 4
_RESIDENT_WORLDS = 16384


def thread_count() -> int:
    """Threads of a CPU launch: ``NEWTON_QD_THREADS``, or one per usable core.

    Raises:
        ValueError: The environment variable is not a positive integer.
    """
    text = os.environ.get("NEWTON_QD_THREADS")
    if text is None:
        return len(os.sched_getaffinity(0))
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(f"NEWTON_QD_THREADS={text!r}: expected an integer of 1 or more")
    return int(text)


def lane_count(worlds: int) -> int:
    """Lanes per world of a GPU launch: ``NEWTON_QD_LANES``, or by batch size.

    Raises:
        ValueError: The environment variable is not one of ``LANES``.
    """
    text = os.environ.get("NEWTON_QD_LANES")
    if text is None:
        return 8 if worlds <= 4096 else 4
    if not text.isdecimal() or int(text) not in LANES:
        raise ValueError(f"NEWTON_QD_LANES={text!r}: expected one of {LANES}")
    return int(text)


class Launcher:
    """The step of one system on one device.

    Scratch memory is allocated once per number of threads (CPU) or worlds in flight
    (GPU) and reused; on a GPU launches of one stream follow each other, so they can
    share it.
    """

    def __init__(self, system: System, device: Any) -> None:
        self.system = system
        self.device = device
        self.kernels = kernels(system.dtype)
        self.model = buffers.build_model(system, device)
        self._scratch: dict[tuple[bool, Any], Any] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._lock = threading.Lock()

    def forward(self, worlds: int, values: Any) -> None:
        """One control step of ``worlds`` worlds.

        Args:
            worlds: Number of worlds.
            values: Struct ``Values`` with inputs and outputs.
        """
        kernel = self.kernels.forward.step_forward

        def launch(
            scratch: Any, count: int, first: int, slot: int, stride: int, lanes: int
        ) -> None:
            wp.launch(
                kernel,
                dim=count * lanes,
                inputs=[self.model, first, slot, stride, lanes, scratch.values, values],
                device=self.device,
                block_dim=_BLOCK,
            )

        self._run(launch, worlds, adjoint=False)

    def backward(self, worlds: int, values: Any, adjoints: Any) -> None:
        """Adjoint of one control step.

        Args:
            worlds: Number of worlds.
            values: Struct ``Values`` with the inputs.
            adjoints: Struct ``Values``: adjoints of the outputs, and where to
                write those of the inputs.
        """
        kernel = self.kernels.backward.step_backward
        structs = self.kernels.structs
        # adjoints travel through the scratch and ``adjoints``, not through Warp's
        unused: list[Any] = [structs.Model(), 0, 0, 0, 0]
        unused += [structs.Scratch(), structs.Scratch(), type(values)(), type(values)()]

        def launch(
            scratch: Any, count: int, first: int, slot: int, stride: int, lanes: int
        ) -> None:
            inputs = [self.model, first, slot, stride, lanes]
            inputs += [scratch.values, scratch.adjoints, values, adjoints]
            wp.launch(
                kernel,
                dim=count * lanes,
                inputs=inputs,
                adj_inputs=unused,
                adjoint=True,
                device=self.device,
                block_dim=_BLOCK,
            )

        self._run(launch, worlds, adjoint=True)

    def inspect(self, kernel: Any, worlds: int, *views: Any) -> None:
        """Run a kernel of :mod:`~newton_qd.physics.kernels.inspect`, one lane a world.

        Args:
            kernel: ``dynamics_forward``, ``kinematics_forward``, or
                ``kinematics_backward``, whose adjoint is run.
            worlds: Number of worlds.
            *views: Struct ``Views``; for the adjoint, a second one with adjoints.
        """
        adjoint = len(views) == 2
        structs = self.kernels.structs

        def launch(
            scratch: Any, count: int, first: int, slot: int, stride: int, lanes: int
        ) -> None:
            held = [scratch.values, *([scratch.adjoints] if adjoint else [])]
            unused = [structs.Model(), 0, 0, 0, *(structs.Scratch() for _ in held)]
            unused += [type(view)() for view in views]
            wp.launch(
                kernel,
                dim=count,
                inputs=[self.model, first, slot, stride, *held, *views],
                adj_inputs=unused if adjoint else [],
                adjoint=adjoint,
                device=self.device,
                block_dim=_BLOCK,
            )

        self._run(launch, worlds, adjoint=adjoint)

    def _run(self, launch: Any, worlds: int, *, adjoint: bool) -> None:
        if worlds == 0:
            return
        if self.device.is_cpu:
            with self._lock:
                self._run_threads(launch, worlds, adjoint=adjoint)
            return
        lanes = lane_count(worlds)
        resident = min(worlds, _RESIDENT_WORLDS)
        scratch = self._get_scratch(resident, adjoint, wp.get_stream().cuda_stream)
        for first in range(0, worlds, resident):
            count = min(resident, worlds - first)
            launch(scratch, count, first, 0, 1, lanes)

    def _run_threads(self, launch: Any, worlds: int, *, adjoint: bool) -> None:
        """Split the worlds over threads; each walks through its share in one slot."""
        threads = min(thread_count(), -(-worlds // _MIN_WORLDS_PER_THREAD))
        scratch = self._get_scratch(threads, adjoint, None)
        bounds = [worlds * n // threads for n in range(threads + 1)]
        if threads > 1 and self._pool is None:
            self._pool = ThreadPoolExecutor(
                thread_count(), thread_name_prefix="newton_qd"
            )
        shares = [
            self._pool.submit(launch, scratch, b - a, a, slot, 0, 1)  # type: ignore[union-attr]
            for slot, (a, b) in enumerate(zip(bounds[1:], bounds[2:], strict=False), 1)
        ]
        launch(scratch, bounds[1], 0, 0, 0, 1)
        for share in shares:
            share.result()

    def _get_scratch(self, slots: int, adjoint: bool, stream: Any) -> Any:
        held = self._scratch.get((adjoint, stream))
        if held is None or held[0] < slots:
            scratch = buffers.build_scratch(
                self.system, slots, self.device, adjoint=adjoint
            )
            held = self._scratch[adjoint, stream] = (slots, scratch)
        return held[1]
