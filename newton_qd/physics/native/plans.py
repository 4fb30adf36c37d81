"""Plans: what the native code needs to run a kernel of a system."""

from __future__ import annotations

import ctypes
import dataclasses
import hashlib
from collections.abc import Sequence
from enum import Enum

import numpy as np
import warp as wp

from newton_qd.physics.native.library import library
from newton_qd.physics.warp_internals import CpuEntry

_ARRAYS, _MEMORIES = 3, 2  # as in the source
_plans: dict[int, Plan] = {}


class _Plan(ctypes.Structure):
    """``Plan`` in ``handler.cpp``."""

    _fields_ = (
        ("key", ctypes.c_int64),
        ("next", ctypes.c_void_p),
        ("kernel", ctypes.c_void_p),
        ("adjoint_arguments", ctypes.c_void_p),
        ("bounds", ctypes.c_void_p),
        ("arguments", ctypes.c_void_p),
        ("argument_bytes", ctypes.c_int64),
        ("arrays", ctypes.c_int64),
        ("array_at", ctypes.c_int64 * _ARRAYS),
        ("row", ctypes.c_int64 * _ARRAYS),
        ("number_bytes", ctypes.c_int64),
        ("width", ctypes.c_int64),
        ("worlds_at", ctypes.c_int64),
        ("memories", ctypes.c_int64),
        ("memory_at", ctypes.c_int64 * _MEMORIES),
        ("memory_bytes", ctypes.c_int64),
        ("packs_per_thread", ctypes.c_int64),
        ("state", ctypes.c_int64),
        ("control", ctypes.c_int64),
        ("parameters", ctypes.c_int64),
        ("fault", ctypes.c_int64),
        ("launches", ctypes.c_int64),
        ("worlds", ctypes.c_int64),
        ("most_worlds", ctypes.c_int64),
        ("pool_lock", ctypes.c_int),
        ("pool", ctypes.c_void_p),
    )


@dataclasses.dataclass(frozen=True)
class Rollouts:
    """What a rollout reads in the rows of a step.

    Attributes:
        state: Numbers of the coordinates and velocities, with which both rows begin.
        control: Numbers of the control, which follows in the inputs.
        parameters: Numbers of the parameters, which end the inputs.
        fault: Place of the fault in the outputs.
    """

    state: int
    control: int
    parameters: int
    fault: int


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """A kernel of a system, as XLA calls it on a CPU.

    Attributes:
        key: Number by which a compiled program finds the plan. It depends on what the
            plan computes only, so programs that JAX has stored find it in a later
            process.
        entry: Kernel and arguments. They stay in memory as long as the plan.
        address: Address of the plan in native memory.
        struct: What is at this address.
    """

    key: int
    entry: CpuEntry
    address: int
    struct: _Plan

    @property
    def launches(self) -> int:
        """Number of launches until now."""
        return self.struct.launches

    @property
    def worlds(self) -> int:
        """Number of worlds of all launches until now."""
        return self.struct.worlds

    @property
    def most_worlds(self) -> int:
        """Number of worlds of the largest launch until now."""
        return self.struct.most_worlds

    def run(self, worlds: int, arrays: Sequence[wp.array]) -> None:
        """Runs the kernel on arrays of rows.

        Args:
            worlds: Number of worlds.
            arrays: Warp arrays with one contiguous row for each world.

        Raises:
            MemoryError: There is no memory for the intermediate values.
        """
        addresses = [array.ptr or 0 for array in arrays]
        if library().run(self.address, worlds, addresses):
            raise MemoryError("the physics ran out of memory")


def add_plan(
    content: object,
    entry: CpuEntry,
    rows: Sequence[int],
    *,
    number_bytes: int,
    width: int = 1,
    memory_bytes: int = 0,
    packs_per_thread: int = 1,
    rollouts: Rollouts | None = None,
) -> Plan:
    """Returns the plan of a kernel. Equal contents have one plan.

    Args:
        content: All that the results depend on: see :func:`_parts`.
        entry: Kernel and arguments.
        rows: Numbers of a row, for each array of the kernel.
        number_bytes: Size of a number.
        width: Worlds that a launch computes.
        memory_bytes: Size of the scratch memory.
        packs_per_thread: Launches for which another thread pays.
        rollouts: What a rollout of the kernel reads; ``None``: there are none.
    """
    digest = hashlib.sha256("\n".join(_parts(content)).encode()).digest()
    key = int.from_bytes(digest[:8], "little", signed=True)
    if key in _plans:
        return _plans[key]
    plan = _Plan()
    plan.key = key
    plan.kernel = entry.function
    plan.bounds = ctypes.addressof(entry.bounds)
    plan.arguments = ctypes.addressof(entry.arguments)
    plan.argument_bytes = ctypes.sizeof(entry.arguments)
    if entry.adjoint_arguments is not None:
        plan.adjoint_arguments = ctypes.addressof(entry.adjoint_arguments)
    offsets = entry.offsets
    arrays = list(offsets)[-len(rows) :]
    memories = [name for name in offsets if name in ("scratch", "adjoints")]
    plan.arrays, plan.memories = len(arrays), len(memories)
    for n, name in enumerate(arrays):
        plan.array_at[n], plan.row[n] = offsets[name], rows[n]
    for n, name in enumerate(memories):
        plan.memory_at[n] = offsets[name] + type(entry.values[name]).memory.offset
    plan.worlds_at = offsets.get("worlds", -1)
    plan.number_bytes, plan.width = number_bytes, width
    plan.memory_bytes, plan.packs_per_thread = memory_bytes, packs_per_thread
    if rollouts is not None:
        plan.state, plan.control = rollouts.state, rollouts.control
        plan.parameters, plan.fault = rollouts.parameters, rollouts.fault
    library().add(ctypes.addressof(plan))
    _plans[key] = Plan(key, entry, ctypes.addressof(plan), plan)
    return _plans[key]


def all_plans() -> tuple[Plan, ...]:
    """Returns the plans of this process."""
    return tuple(_plans.values())


def _parts(content: object) -> list[str]:
    """Returns texts that differ for contents that differ.

    They are the same in another process for dataclasses, sequences, dictionaries,
    arrays, numbers and texts.
    """
    if isinstance(content, np.ndarray):
        numbers = np.ascontiguousarray(content)
        digest = hashlib.sha256(numbers.tobytes()).hexdigest()
        return [f"array {numbers.dtype.str} {numbers.shape} {digest}"]
    if isinstance(content, Enum):
        return [str(content)]
    if dataclasses.is_dataclass(content):
        names = [field.name for field in dataclasses.fields(content)]
        fields = {name: getattr(content, name) for name in names}
        content = (type(content).__qualname__, fields)
    if isinstance(content, dict):
        content = [item for pair in content.items() for item in pair]
    if isinstance(content, (tuple, list)):
        parts = [part for item in content for part in _parts(item)]
        return [f"sequence {len(content)}", *parts, "end"]
    return [f"{type(content).__name__} {content!r}"]
