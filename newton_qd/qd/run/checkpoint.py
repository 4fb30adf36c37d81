"""The checkpoint of a run.

A checkpoint is one file: a line with a format number and the SHA-256 of the rest,
then a NumPy archive. With the digest, every damage leads to the same clear error.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import warnings
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from newton_qd import memory
from newton_qd.checks import message
from newton_qd.files import write_atomically

# Change the number if the contents of a checkpoint or the columns of metrics change.
_MAGIC = b"newton_qd checkpoint 2 "


# Errors of NumPy and zipfile for a damaged file. A header may ask for any memory.
DAMAGE = (
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    NotImplementedError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    zipfile.BadZipFile,
    zlib.error,
)


class CheckpointError(RuntimeError):
    """A checkpoint is damaged or belongs to another run."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """State of an evolution between two generations.

    Attributes:
        settings: Settings of the run as JSON, to detect files of another run.
        iteration: Generations that are finished.
        genotypes: (cells, parameters) policy weights, zero in empty cells.
        fitnesses: (cells,) fitnesses, ``-inf`` in empty cells.
        descriptors: (cells, D) descriptors, zero in empty cells.
        centroids: (cells, D) centres of the cells.
        metrics: (iteration + 1, columns) rows of ``metrics.csv``.
        emitter: The leaves of the state of the algorithm's emitter.
    """

    settings: str
    iteration: int
    genotypes: np.ndarray
    fitnesses: np.ndarray
    descriptors: np.ndarray
    centroids: np.ndarray
    metrics: np.ndarray
    emitter: tuple[np.ndarray, ...] = ()


def npz_bytes(**arrays: np.ndarray) -> bytes:
    """Packs arrays into the bytes of an uncompressed ``.npz`` file."""
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **arrays)
    return buffer.getvalue()


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Writes a checkpoint atomically."""
    fields = {
        field.name: np.asarray(getattr(checkpoint, field.name))
        for field in dataclasses.fields(checkpoint)
        if field.name != "emitter"
    }
    leaves = {f"emitter_{i}": leaf for i, leaf in enumerate(checkpoint.emitter)}
    payload = npz_bytes(**fields, **leaves)
    digest = hashlib.sha256(payload).hexdigest().encode()
    write_atomically(path, _MAGIC + digest + b"\n" + payload)


def load_checkpoint(path: Path) -> Checkpoint:
    """Reads a checkpoint.

    Args:
        path: File written by ``save_checkpoint``.

    Raises:
        CheckpointError: The file is damaged or has another format.
    """
    content = path.read_bytes()
    head, separator, payload = content.partition(b"\n")
    if not separator or not head.startswith(_MAGIC):
        raise CheckpointError(
            f"{path} is not a checkpoint of this version of newton_qd, or its "
            "beginning is damaged"
        )
    if hashlib.sha256(payload).hexdigest().encode() != head[len(_MAGIC) :]:
        raise CheckpointError(f"{path} is damaged (checksum differs)")
    try:
        return _from_arrays(read_npz(payload))
    except DAMAGE as error:
        raise CheckpointError(f"{path} does not hold a checkpoint ({error})") from error


def read_npz(content: bytes) -> dict[str, np.ndarray]:
    """Returns the arrays of a ``.npz`` file. It runs no code and unpickles nothing.

    Raises:
        MemoryError: The arrays do not fit in memory.
        ValueError: The file is damaged; other errors of ``DAMAGE`` are possible, too.
    """
    sizes = [item.file_size for item in zipfile.ZipFile(io.BytesIO(content)).infolist()]
    most = memory.limit()
    if most is not None and sum(sizes) > most:
        raise MemoryError(f"arrays of {sum(sizes):,} bytes")
    with warnings.catch_warnings():
        # NumPy warns about headers that an old Python wrote, or that nobody did.
        warnings.simplefilter("ignore")
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            found = {name: arrays[name] for name in arrays.files}
    wrong = [name for name, array in found.items() if not isinstance(array, np.ndarray)]
    if wrong:
        raise ValueError(message("array", wrong[0], "arrays of NumPy"))
    return found


def _from_arrays(arrays: Mapping[str, np.ndarray]) -> Checkpoint:
    """Makes a checkpoint from the arrays of its file.

    Raises:
        ValueError: Arrays are missing, or do not fit together.
    """
    fields: dict[str, Any] = {
        field.name: arrays[field.name]
        for field in dataclasses.fields(Checkpoint)
        if field.name != "emitter"
    }
    count = sum(name.startswith("emitter_") for name in arrays)
    leaves = tuple(arrays[f"emitter_{i}"] for i in range(count))
    cells, size = fields["genotypes"].shape
    width = fields["centroids"].shape[1]
    shapes = {"fitnesses": (cells,), "descriptors": (cells, width)}
    shapes |= {"centroids": (cells, width), "genotypes": (cells, size)}
    for name, shape in shapes.items():
        if fields[name].shape != shape or fields[name].dtype.kind != "f":
            raise ValueError(message(name, fields[name], f"floats of shape {shape}"))
    if fields["metrics"].ndim != 2 or fields["metrics"].dtype.kind != "f":
        raise ValueError(message("metrics", fields["metrics"], "a table of floats"))
    if fields["settings"].dtype.kind != "U" or fields["settings"].ndim:
        raise ValueError(message("settings", fields["settings"], "text"))
    fields["settings"] = str(fields["settings"])
    fields["iteration"] = int(fields["iteration"])
    return Checkpoint(**fields, emitter=leaves)
