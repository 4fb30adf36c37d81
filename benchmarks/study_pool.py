"""The processes of the study."""

from __future__ import annotations

import argparse
import dataclasses
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

STUDY = Path(__file__).resolve().parent / "study.py"


@dataclasses.dataclass
class Pool:
    """Processes, one in each slot.

    Attributes:
        args: Arguments of the command.
        slots: The process of each slot, or ``None``.
        gpus: Number of GPUs.
        failed: How many processes have failed.
    """

    args: argparse.Namespace
    slots: list[subprocess.Popen | None]
    gpus: int
    failed: int = 0

    def free(self) -> int | None:
        """A slot without a process that still runs."""
        for slot, process in enumerate(self.slots):
            if process is None or process.poll() is not None:
                self._end(slot)
                return slot
        return None

    def _end(self, slot: int) -> None:
        """Waits for the process of a slot, and says so if it has failed."""
        process, self.slots[slot] = self.slots[slot], None
        if process is not None and process.wait():
            self.failed += 1
            print(f"failed: {process.args}", file=sys.stderr, flush=True)

    def start(self, slot: int, *what: str) -> None:
        """Starts ``study.py`` again with other arguments."""
        args = self.args
        common = ["--device", args.device, "--protocol", args.protocol]
        command = [sys.executable, str(STUDY), *common, *what]
        variables = {**os.environ, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        if args.protocol != "core":  # other seeds can use what was compiled
            cache = str((args.out / "compiled").resolve())
            variables.setdefault("JAX_COMPILATION_CACHE_DIR", cache)
        if args.device == "cuda":
            variables["CUDA_VISIBLE_DEVICES"] = str(slot % self.gpus)
        else:
            variables.update(JAX_PLATFORMS="cpu", CUDA_VISIBLE_DEVICES="")
            cores = sorted(os.sched_getaffinity(0))
            share = cores[slot % len(cores) :: len(self.slots)]
            command += ["--cores", *map(str, share)]
        # Ctrl-C in a terminal reaches all processes; ``stop`` ends them
        handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
        self.slots[slot] = subprocess.Popen(command, env=variables)
        signal.signal(signal.SIGINT, handler)

    def wait(self) -> int:
        """Waits for a free slot."""
        while (slot := self.free()) is None:
            time.sleep(0.2)
        return slot

    def stop(self) -> None:
        """Ends all processes; their files are whole, so they can be continued."""
        running = [process for process in self.slots if process is not None]
        for process in running:
            process.terminate()
        for process in running:
            process.wait()

    def drain(self) -> None:
        """Waits for all processes."""
        for slot in range(len(self.slots)):
            self._end(slot)
