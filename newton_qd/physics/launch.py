"""Launches the kernels on Warp arrays: with threads on a CPU, with lanes on a GPU."""

from __future__ import annotations

import dataclasses
import os

import warp as wp

from newton_qd.checks import listed, message
from newton_qd.physics import buffers, layout
from newton_qd.physics.native import Plan, Rollouts
from newton_qd.physics.native.library import usable_cores
from newton_qd.physics.precision import BUILDING, pack_width
from newton_qd.physics.system import System
from newton_qd.physics.warp_internals import cpu_entry

Arrays = tuple[wp.array, ...]

LANES = (1, 2, 4, 8, 16, 32)
# Module of each kernel of packs. Warp compiles whole modules, so each has its own.
MODULES = {
    "bodies_forward": "bodies",
    "bodies_backward": "bodies_backward",
    "dynamics_forward": "dynamics",
    "step_forward": "forward",
    "step_backward": "backward",
    "contact_gaps": "gaps",
    "contact_impulses": "impulses",
}
# Kernels with lanes, and the fastest number of them on an H200. A tree without branches
# leaves most lanes idle, so many worlds of it take fewer. docs/verification.md has the
# measurements.
_LANE_KERNELS = ("step_forward", "step_backward")
_LANES = 8
_MANY_WORLDS = 8192
_LANES_OF_MANY_CHAINS = 4
# Minimum number of packs per thread, without and with adjoint. For fewer packs, waking
# another thread takes longer than the work that it saves.
_PACKS_PER_THREAD = {False: 4, True: 2}
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
        return usable_cores()
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(message("NEWTON_QD_THREADS", text, "integers from 1"))
    return int(text)


def lane_count(kernel: str, worlds: int = 1, branches: bool = True) -> int:
    """Returns the number of lanes per world of a GPU launch.

    It is ``NEWTON_QD_LANES``, or by default the number that was measured as fastest.
    An adjoint has one lane where ``NEWTON_QD_DETERMINISTIC`` is 1: lanes add to
    gradients in no fixed order, but change no value of a step.

    Args:
        kernel: Name of the kernel. Only the kernels of the step support several lanes;
            the result for all others is 1.
        worlds: Number of worlds of the launch.
        branches: Whether a body of the robot has several children.

    Raises:
        ValueError: ``NEWTON_QD_LANES`` is not one of ``LANES``, or
            ``NEWTON_QD_DETERMINISTIC`` is not 0 or 1.
    """
    if kernel not in _LANE_KERNELS:
        return 1
    fixed = os.environ.get("NEWTON_QD_DETERMINISTIC", "0")
    if fixed not in ("0", "1"):
        raise ValueError(message("NEWTON_QD_DETERMINISTIC", fixed, "0, 1"))
    if fixed == "1" and kernel == "step_backward":
        return 1
    text = os.environ.get("NEWTON_QD_LANES")
    if text is None:
        many = worlds > _MANY_WORLDS and not branches
        return _LANES_OF_MANY_CHAINS if many else _LANES
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

    On a CPU the native code of :mod:`newton_qd.physics.native` runs them. On a GPU each
    stream has its own scratch memory and launch commands. They are created once and
    reused. Launches in one stream run one after the other, so they can share the
    memory.
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
        self._branches = self.model.levels > 1
        self._scratch: dict[tuple[bool, int], tuple[int, buffers.Memory]] = {}
        self._commands: dict[tuple[str, int, bool], _Command] = {}
        self._plans: dict[str, Plan] = {}

    def prepare(self, name: str) -> wp.Module:
        """Compile a kernel now, before a callback needs it. Returns its module."""
        module = self._kernel(name).module
        with BUILDING:
            module.load(self.device, self._block)
        return module

    def plan(self, name: str) -> Plan:
        """Returns a kernel as XLA calls it on a CPU. It is compiled first.

        Args:
            name: Name of the kernel. If it ends in ``_backward``, its adjoint runs.
        """
        with BUILDING:
            if name not in self._plans:
                self._plans[name] = self._build_plan(name)
        return self._plans[name]

    def forward(self, worlds: int, x: wp.array, y: wp.array) -> None:
        """Run one control step. :mod:`~newton_qd.physics.layout` defines the rows.

        Args:
            worlds: Number of worlds.
            x: (worlds * inputs,) Warp array to read.
            y: (worlds * outputs,) Warp array to write.

        Raises:
            ValueError: The value of ``NEWTON_QD_THREADS``, ``NEWTON_QD_LANES`` or
                ``NEWTON_QD_DETERMINISTIC`` is not allowed.
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
            ValueError: The value of ``NEWTON_QD_THREADS``, ``NEWTON_QD_LANES`` or
                ``NEWTON_QD_DETERMINISTIC`` is not allowed.
        """
        if worlds == 0:
            return
        if self.device.is_cpu:
            thread_count()  # raises for a wrong setting
            self.plan(name).run(worlds, arrays)
            return
        kernel = self._kernel(name)
        resident = min(-(-worlds // _WARP) * _WARP, _RESIDENT_WORLDS[adjoint])
        owner = wp.get_stream(self.device).cuda_stream
        commands = [self._command(kernel, owner, resident, arrays, adjoint)]
        lanes = [lane_count(name, worlds, self._branches)]
        if adjoint:  # a launch of its own runs the parts of the kernel, see `part`
            forward = self._command(
                kernel, owner, resident, arrays, adjoint, parts=True
            )
            commands.insert(0, forward)
            run_first = name.replace("backward", "forward")
            lanes.insert(0, lane_count(run_first, worlds, self._branches))
        for first in range(0, worlds, resident):
            count = min(resident, worlds - first)
            for command, number in zip(commands, lanes, strict=True):
                side = worlds_side_by_side(number)
                threads = -(-count // side) * side * number
                command.send(arrays, first, count, threads, 1, number, side * number)

    def _kernel(self, name: str) -> wp.Kernel:
        return getattr(getattr(self.kernels, MODULES[name]), name)

    def _build_plan(self, name: str) -> Plan:
        adjoint = name.endswith("_backward")
        before, after = layout.rows(self.system, name, self.parametric)
        kernel = self._kernel(name)
        scratch = buffers.build_scratch(
            self.system, 1, self.device, adjoint=adjoint, parametric=self.parametric
        )
        memory = scratch.values.memory
        number_bytes = wp.types.type_size_in_bytes(memory.dtype)
        rows = [before.size, after.size, before.size][: 3 if adjoint else 2]
        empty = wp.zeros(1, dtype=memory.dtype, device=self.device)
        arrays = tuple(empty for _ in rows)
        launch = self._record(kernel, scratch, arrays, adjoint, False).launch
        own = layout.parameters(self.system).size if self.parametric else 0
        rollouts = None
        if name.startswith("step"):
            rollouts = Rollouts(
                state=self.system.nq + self.system.nv,
                control=self.system.nu,
                parameters=own,
                fault=after["fault"].offset,
            )
        # all that the arguments of the kernel depend on
        solves = buffers.substep_solves(self.system)
        return Plan(
            (name, self.parametric, self.system, solves),
            cpu_entry(launch, adjoint),
            rows,
            number_bytes=number_bytes,
            width=self.width,
            memory_bytes=memory.size * number_bytes,
            packs_per_thread=_PACKS_PER_THREAD[adjoint],
            rollouts=rollouts,
        )

    def _command(
        self,
        kernel: wp.Kernel,
        owner: int,
        slots: int,
        arrays: Arrays,
        adjoint: bool,
        parts: bool = False,
    ) -> _Command:
        """Returns the recorded launch of ``kernel`` in a stream's scratch memory.

        ``parts`` is for the launch that runs a kernel with adjoint forward.
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
