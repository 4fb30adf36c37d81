"""Plans: what the native code needs to run a kernel of a system."""

from __future__ import annotations

import ctypes
import dataclasses
import hashlib
import threading
import weakref
from collections.abc import Sequence
from enum import Enum

import numpy as np
import warp as wp

from newton_qd.physics.native.library import library
from newton_qd.physics.warp_internals import CpuEntry

_ARRAYS, _MEMORIES, _EXHAUSTED = 3, 2, 8  # as in the source
_plans: dict[int, Plan] = {}
_lock = threading.Lock()


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


class Plan:
    """A kernel of a system, as the native code runs it on a CPU.

    Attributes:
        key: Number by which a compiled program finds the plan. It depends on what the
            plan computes only, so programs that JAX has stored find it in a later
            process.
        number_bytes: Size of a number.
    """

    def __init__(
        self,
        content: object,
        entry: CpuEntry,
        rows: Sequence[int],
        *,
        number_bytes: int,
        width: int = 1,
        memory_bytes: int = 0,
        packs_per_thread: int = 1,
        rollouts: Rollouts | None = None,
    ) -> None:
        """Writes down what the native code needs.

        Args:
            content: All that the results depend on: see :func:`_parts`.
            entry: Kernel and arguments. They stay in memory as long as the plan.
            rows: Numbers of a row, for each array of the kernel.
            number_bytes: Size of a number.
            width: Worlds that a launch computes.
            memory_bytes: Size of the scratch memory.
            packs_per_thread: Launches for which another thread pays.
            rollouts: What a rollout of the kernel reads; ``None``: there are none.
        """
        self.number_bytes = number_bytes
        self.key = _key(content)
        self._entry = entry
        self._struct = struct = _Plan(key=self.key, kernel=entry.function)
        struct.bounds = ctypes.addressof(entry.bounds)
        struct.arguments = ctypes.addressof(entry.arguments)
        struct.argument_bytes = ctypes.sizeof(entry.arguments)
        if entry.adjoint_arguments is not None:
            struct.adjoint_arguments = ctypes.addressof(entry.adjoint_arguments)
        offsets = entry.offsets
        arrays = list(offsets)[-len(rows) :]
        memories = [name for name in offsets if name in ("scratch", "adjoints")]
        struct.arrays, struct.memories = len(arrays), len(memories)
        for n, name in enumerate(arrays):
            struct.array_at[n], struct.row[n] = offsets[name], rows[n]
        for n, name in enumerate(memories):
            struct.memory_at[n] = offsets[name] + type(entry.values[name]).memory.offset
        struct.worlds_at = offsets.get("worlds", -1)
        struct.number_bytes, struct.width = number_bytes, width
        struct.memory_bytes = memory_bytes
        struct.packs_per_thread = packs_per_thread
        for name, number in vars(rollouts or Rollouts(0, 0, 0, 0)).items():
            setattr(struct, name, number)
        # at the end of Python a kernel may still run
        weakref.finalize(self, library().free, struct).atexit = False

    def register(self) -> None:
        """Lets compiled programs find the plan by its key, from now on.

        The first plan of equal contents stays. A plan may be registered again: the
        native code has it once, because its lists would have no end otherwise.
        """
        with _lock:
            if self.key not in _plans:
                _plans[self.key] = self
                library().add(self._struct)

    @property
    def launches(self) -> int:
        """Number of launches until now."""
        return self._struct.launches

    @property
    def worlds(self) -> int:
        """Number of worlds of all launches until now."""
        return self._struct.worlds

    @property
    def most_worlds(self) -> int:
        """Number of worlds of the largest launch until now."""
        return self._struct.most_worlds

    def run(self, worlds: int, arrays: Sequence[wp.array]) -> None:
        """Runs the kernel on arrays of rows.

        Args:
            worlds: Number of worlds.
            arrays: Warp arrays with one contiguous row for each world.

        Raises:
            MemoryError: There is no memory for the intermediate values.
            RuntimeError: Python ends.
        """
        addresses = [array.ptr or 0 for array in arrays]
        error = library().run(self._struct, worlds, addresses)
        if error == _EXHAUSTED:
            raise MemoryError("the physics ran out of memory")
        if error:
            raise RuntimeError("the physics was stopped, because Python ends")


def all_plans() -> tuple[Plan, ...]:
    """Returns the plans of this process that compiled programs can find."""
    return tuple(_plans.values())


def _key(content: object) -> int:
    digest = hashlib.sha256("\n".join(_parts(content)).encode()).digest()
    return int.from_bytes(digest[:8], "little", signed=True)


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
