"""Launches the kernels on Warp arrays: with threads on a CPU, with lanes on a GPU."""

from __future__ import annotations

import dataclasses
import os
import threading

import warp as wp

from newton_qd.checks import listed, message
from newton_qd.physics import buffers, layout
from newton_qd.physics.precision import pack_width
from newton_qd.physics.system import System
from newton_qd.physics.workers import Worker

Arrays = tuple[wp.array, ...]

LANES = (1, 2, 4, 8, 16, 32)
# Modules of the kernels that are not in ``inspect``. Warp compiles whole modules.
_MODULES = {
    "step_forward": "forward",
    "step_backward": "backward",
    "contact_gaps": "gaps",
    "contact_impulses": "impulses",
}
# The fastest numbers of lanes on an H200, up to a number of worlds and beyond: a small
# batch needs more lanes to fill the GPU. docs/verification.md has the measurements.
_MANY_WORLDS = 8192
_LANES = {"step_forward": (8, 8), "step_backward": (8, 4)}
# Minimum number of packs per thread, without and with adjoint. For fewer packs, waking
# another thread from Python takes longer than the work that it saves.
_PACKS_PER_THREAD = {False: 16, True: 4}
# Threads of a block at most, and worlds of a warp, as in ``kernels.world``.
_GPU_BLOCK = 256
_WARP = 32
# Worlds of a launch at most, without and with adjoint: each has its own scratch memory.
_RESIDENT_WORLDS = {False: 65536, True: 16384}


def thread_count() -> int:
    """Returns the number of threads of a CPU launch.

    It is ``NEWTON_QD_THREADS``, or by default the number of usable cores.

    Raises:
        ValueError: The environment variable is not a positive integer.
    """
    text = os.environ.get("NEWTON_QD_THREADS")
    if text is None:
        if hasattr(os, "sched_getaffinity"):  # Linux
            return len(os.sched_getaffinity(0))
        return os.cpu_count() or 1
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(message("NEWTON_QD_THREADS", text, "integers from 1"))
    return int(text)


def lane_count(kernel: str, worlds: int = 1) -> int:
    """Returns the number of lanes per world of a GPU launch.

    It is ``NEWTON_QD_LANES``, or by default the number that was measured as fastest.

    Args:
        kernel: Name of the kernel. Only the kernels of the step support several lanes;
            the result for all others is 1.
        worlds: Number of worlds of the launch.

    Raises:
        ValueError: The environment variable is not one of ``LANES``.
    """
    if kernel not in _LANES:
        return 1
    text = os.environ.get("NEWTON_QD_LANES")
    if text is None:
        return _LANES[kernel][worlds > _MANY_WORLDS]
    if not text.isdecimal() or int(text) not in LANES:
        raise ValueError(message("NEWTON_QD_LANES", text, listed(LANES)))
    return int(text)


def worlds_side_by_side(lanes: int) -> int:
    """Returns how many worlds a block of a GPU computes with this number of lanes."""
    return min(_WARP, _GPU_BLOCK // lanes)


def output_size(system: System) -> int:
    """Returns the length of the row that a step writes for one world."""
    return layout.outputs(system).size


@dataclasses.dataclass(frozen=True)
class _Command:
    """A recorded launch, and the index of the first array in its arguments."""

    launch: wp.Launch
    first_array: int

    def send(
        self,
        arrays: Arrays,
        first: int,
        worlds: int,
        threads: int,
        slot_stride: int,
        lanes: int,
        block: int,
    ) -> None:
        """Launch the kernel on ``worlds`` worlds, starting with world ``first``."""
        # The block of a recorded launch needs no compilation of its own.
        self.launch.block_dim = block
        self.launch.set_dim(threads)
        for index, value in enumerate((first, slot_stride, worlds, lanes), 1):
            self.launch.set_param_at_index(index, value)
        for index, array in enumerate(arrays, self.first_array):
            self.launch.set_param_at_index(index, array)
        self.launch.launch()


class Launcher:
    """Launches the kernels of one system on one device.

    Each thread (CPU) or stream (GPU) has its own scratch memory and launch commands.
    They are created once and reused. Launches in one stream run one after the other,
    so they can share the memory.
    """

    def __init__(
        self, system: System, device: wp.Device, parametric: bool = False
    ) -> None:
        """Copies the system to the device.

        Args:
            system: The system.
            device: Warp device.
            parametric: Whether each row of inputs ends with the world's parameters.
        """
        self.system = system
        self.device = device
        self.width = pack_width(system.dtype, device)
        self.parametric = parametric
        self.kernels = buffers.kernels_of(system, device, parametric)
        self.model = buffers.build_model(system, device, parametric)
        self._block = 1 if device.is_cpu else _GPU_BLOCK
        self._scratch: dict[tuple[bool, int], tuple[int, buffers.Memory]] = {}
        self._commands: dict[tuple[str, int, bool], _Command] = {}
        self._workers: list[Worker] = []
        self._lock = threading.Lock()

    def prepare(self, name: str) -> wp.Module:
        """Compile a kernel now, before a callback needs it. Returns its module."""
        module = self._kernel(name).module
        module.load(self.device, self._block)
        return module

    def forward(self, worlds: int, x: wp.array, y: wp.array) -> None:
        """Run one control step. :mod:`~newton_qd.physics.layout` defines the rows.

        Args:
            worlds: Number of worlds.
            x: (worlds * inputs,) Warp array to read.
            y: (worlds * outputs,) Warp array to write.

        Raises:
            ValueError: The value of ``NEWTON_QD_THREADS`` or ``NEWTON_QD_LANES`` is
                not allowed.
        """
        self.launch("step_forward", worlds, x, y)

    def launch(
        self,
        name: str,
        worlds: int,
        *arrays: wp.array,
        adjoint: bool = False,
    ) -> None:
        """Run a kernel, or its adjoint, on all worlds.

        Args:
            name: Name of the kernel. Its arguments are: model, first world, slot
                stride, number of worlds, lanes, scratch (and its adjoint), then
                ``arrays``.
            worlds: Number of worlds.
            *arrays: Warp arrays with one contiguous row for each world.
            adjoint: Whether to run the adjoint of the kernel.

        Raises:
            ValueError: The value of ``NEWTON_QD_THREADS`` or ``NEWTON_QD_LANES`` is
                not allowed.
        """
        if worlds == 0:
            return
        kernel = self._kernel(name)
        if self.device.is_cpu:
            with self._lock:
                self._launch_threads(kernel, worlds, arrays, adjoint)
            return
        resident = min(-(-worlds // _WARP) * _WARP, _RESIDENT_WORLDS[adjoint])
        owner = wp.get_stream(self.device).cuda_stream
        commands = [self._command(kernel, owner, resident, arrays, adjoint)]
        lanes = [lane_count(name, worlds)]
        if adjoint:  # a launch of its own runs the parts of the kernel, see `part`
            forward = self._command(
                kernel, owner, resident, arrays, adjoint, parts=True
            )
            commands.insert(0, forward)
            lanes.insert(0, lane_count(name.replace("backward", "forward"), worlds))
        for first in range(0, worlds, resident):
            count = min(resident, worlds - first)
            for command, number in zip(commands, lanes, strict=True):
                side = worlds_side_by_side(number)
                threads = -(-count // side) * side * number
                command.send(arrays, first, count, threads, 1, number, side * number)

    def _kernel(self, name: str) -> wp.Kernel:
        return getattr(getattr(self.kernels, _MODULES.get(name, "inspect")), name)

    def _launch_threads(
        self,
        kernel: wp.Kernel,
        worlds: int,
        arrays: Arrays,
        adjoint: bool,
    ) -> None:
        """Split the packs over threads. Each thread computes its packs in one slot."""
        packs = -(-worlds // self.width)
        threads = min(thread_count(), -(-packs // _PACKS_PER_THREAD[adjoint]))
        bounds = [packs * n // threads * self.width for n in range(threads)] + [worlds]
        while len(self._workers) < threads - 1:
            self._workers.append(Worker(f"newton_qd-{len(self._workers) + 1}"))
        # Each thread has its own memory, because shared cache lines are slow.
        commands = [
            self._command(kernel, thread, 1, arrays, adjoint)
            for thread in range(threads)
        ]
        for n, worker in enumerate(self._workers[: threads - 1], 1):
            first, end = bounds[n : n + 2]
            worker.start(self._send_share, commands[n], arrays, first, end)
        try:
            self._send_share(commands[0], arrays, *bounds[:2])
        finally:
            for worker in self._workers[: threads - 1]:
                worker.wait()

    def _send_share(
        self, command: _Command, arrays: Arrays, first: int, end: int
    ) -> None:
        worlds = end - first
        command.send(arrays, first, worlds, -(-worlds // self.width), 0, 1, 1)

    def _command(
        self,
        kernel: wp.Kernel,
        owner: int,
        slots: int,
        arrays: Arrays,
        adjoint: bool,
        parts: bool = False,
    ) -> _Command:
        """Returns the recorded launch of ``kernel`` in the owner's scratch memory.

        The owner is a thread (CPU) or a stream (GPU). ``parts`` is for the launch that
        runs a kernel with adjoint forward.
        """
        held = self._scratch.get((adjoint, owner))
        if held is None or held[0] < slots:
            scratch = buffers.build_scratch(
                self.system,
                slots,
                self.device,
                adjoint=adjoint,
                parametric=self.parametric,
            )
            held = self._scratch[adjoint, owner] = (slots, scratch)
            self._commands.clear()
        command = self._commands.get((kernel.key, owner, parts))
        if command is None:
            command = self._record(kernel, held[1], arrays, adjoint, parts)
            self._commands[kernel.key, owner, parts] = command
        return command

    def _record(
        self,
        kernel: wp.Kernel,
        scratch: buffers.Memory,
        arrays: Arrays,
        adjoint: bool,
        parts: bool,
    ) -> _Command:
        structs = self.kernels.structs
        held = [scratch.values, *([scratch.adjoints] if adjoint else [])]
        # Adjoints are stored in the scratch memory and in ``arrays``. Warp's own
        # adjoint arguments are not used.
        unused = [structs.Model(), 0, 0, 0, 0, *(structs.Scratch() for _ in held)]
        unused += [None for _ in arrays]
        before = [self.model, 0, 0, 0, 1, *held]
        launch = wp.launch(
            kernel,
            dim=1,
            inputs=[*before, *arrays],
            adj_inputs=[] if parts or not adjoint else unused,
            adjoint=adjoint and not parts,
            device=self.device,
            block_dim=self._block,
            record_cmd=True,
        )
        assert isinstance(launch, wp.Launch)  # because of record_cmd
        return _Command(launch, len(before))
