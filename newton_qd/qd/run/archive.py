"""The archive of an evolution and its file, which later versions can read too."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.qd.run.checkpoint import DAMAGE, Checkpoint, npz_bytes, read_npz

if TYPE_CHECKING:  # the command line opens archives without JAX
    from newton_qd.types import Repertoire

ARCHIVE = "archive.npz"
FORMAT = 1
"""Number of the file's format. Keep a reader for each earlier format."""


class ArchiveError(RuntimeError):
    """The file of an archive is damaged, or has an unknown format."""


@dataclasses.dataclass(frozen=True)
class Archive:
    """The elites of an evolution, one row per cell.

    Attributes:
        genotypes: (cells, parameters) policy weights, zero in empty cells.
        fitnesses: (cells,) fitnesses, ``-inf`` in empty cells.
        descriptors: (cells, D) descriptors, zero in empty cells.
        centroids: (cells, D) centres of the cells.
    """

    genotypes: np.ndarray
    fitnesses: np.ndarray
    descriptors: np.ndarray
    centroids: np.ndarray

    def __repr__(self) -> str:
        cells, size = self.genotypes.shape
        return f"<Archive: {self.filled.sum()} of {cells} cells, {size:,} weights each>"

    @property
    def filled(self) -> np.ndarray:
        """(cells,) whether a cell holds an individual."""
        return np.isfinite(self.fitnesses)


def archive_of(state: Checkpoint) -> Archive:
    """Returns the archive in a checkpoint."""
    return Archive(*(getattr(state, f.name) for f in dataclasses.fields(Archive)))


def repertoire_of(archive: Archive | Checkpoint) -> Repertoire:
    """Returns an archive as ``MapElitesRepertoire`` of QDax."""
    import jax.numpy as jnp
    from qdax.core.containers.mapelites_repertoire import MapElitesRepertoire

    return MapElitesRepertoire(
        genotypes=jnp.asarray(archive.genotypes),
        fitnesses=jnp.asarray(archive.fitnesses[:, None]),
        extra_scores={},
        keys_extra_scores=(),
        descriptors=jnp.asarray(archive.descriptors),
        centroids=jnp.asarray(archive.centroids),
    )


def archive_bytes(archive: Archive) -> bytes:
    """Packs an archive into the bytes of ``archive.npz``."""
    arrays = {f.name: getattr(archive, f.name) for f in dataclasses.fields(archive)}
    return npz_bytes(format=np.asarray(FORMAT), **arrays)


def load_archive(folder: str | os.PathLike[str]) -> Archive:
    """Reads ``archive.npz`` of a results folder.

    Args:
        folder: Results folder of ``evolve``, of this or an earlier version.

    Raises:
        ArchiveError: The file is damaged, or was written by a later version.
        FileNotFoundError: The file does not exist.
        TypeError: ``folder`` is no path.
    """
    checks.instance("folder", folder, (str, os.PathLike), "a results folder of evolve")
    path = Path(folder) / ARCHIVE
    try:
        content = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError) as error:
        allowed = "the folder of a run that has saved its archive or a checkpoint"
        missing = message("folder", Fact(f"{folder}, which has no {ARCHIVE}"), allowed)
        raise FileNotFoundError(missing) from error
    try:
        found = read_npz(content)
    except DAMAGE as error:
        raise ArchiveError(f"{path} is damaged: {error}") from error
    # The first files of format 1 have no number.
    version = found.pop("format", np.asarray(FORMAT))
    if version.shape != () or version.dtype.kind not in "iu" or version != FORMAT:
        raise ArchiveError(
            f"{path} has format {version}; this version of newton_qd reads format "
            f"{FORMAT}"
        )
    return _from_arrays(path, found)


def _from_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> Archive:
    """Makes an archive from the arrays of a file of format 1.

    Raises:
        ArchiveError: Arrays are missing or do not fit together.
    """
    names = [field.name for field in dataclasses.fields(Archive)]
    if sorted(arrays) != sorted(names):
        raise ArchiveError(
            f"{path} holds the arrays {sorted(arrays)}, not {sorted(names)}"
        )
    shapes = {name: arrays[name].shape for name in names}
    cells, size = [*shapes["genotypes"], 0, 0][:2]
    width = [*shapes["centroids"], 0, 0][1]
    allowed = {
        "genotypes": (cells, size),
        "fitnesses": (cells,),
        "descriptors": (cells, width),
        "centroids": (cells, width),
    }
    if shapes != allowed:
        raise ArchiveError(f"{path} holds arrays that do not fit together: {shapes}")
    for name in names:
        if arrays[name].dtype.kind != "f":
            raise ArchiveError(f"{path}: {name} are {arrays[name].dtype}, not floats")
    return Archive(**arrays)
