"""Genotypes of another archive, as the initial population of a run."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.qd.config import ConfigError
from newton_qd.qd.run.archive import ARCHIVE
from newton_qd.qd.run.folder import CHECKPOINT
from newton_qd.qd.run.results import read_archive
from newton_qd.qd.scoring.rollout import Policy
from newton_qd.types import PyTree

StartFrom: TypeAlias = Any
"""A results folder, ``Run``, ``EvolveResult``, ``Archive``, or a repertoire of QDax or
an archive of pyribs."""

_ALLOWED = (
    "a results folder, a Run, an EvolveResult, an Archive, a repertoire of QDax, "
    "an archive of pyribs"
)


def start_genotypes(source: StartFrom, policy: Policy) -> np.ndarray:
    """Returns the genotypes (N, size) of the elites of an archive, the best first.

    Args:
        source: The archive.
        policy: Policy of the run, whose weights the genotypes must be.

    Raises:
        ArchiveError: The file in the results folder is damaged.
        CheckpointError: The checkpoint in it is damaged, and it has no archive.
        ConfigError: It is no archive, it is empty, or its genotypes are not finite
            weights of this policy.
    """
    genotypes, fitnesses = _contents(source)
    if np.isnan(fitnesses).any():
        given = Fact(f"an archive with NaN as fitness of {np.isnan(fitnesses).sum()}")
        allowed = "finite fitnesses, -inf in empty cells"
        raise ConfigError(message("start_from", given, allowed))
    filled = np.flatnonzero(np.isfinite(fitnesses))
    if not len(filled):
        allowed = "one with elites"
        raise ConfigError(message("start_from", Fact("an empty archive"), allowed))
    order = filled[np.argsort(-fitnesses[filled], kind="stable")]
    found = _weights(genotypes, policy)[order]
    if not np.isfinite(found).all():
        given = Fact("genotypes that are not finite")
        raise ConfigError(message("start_from", given, "finite weights"))
    return found


def digest_of(genotypes: np.ndarray) -> str:
    """Returns the SHA-256 of genotypes (N, size), for the settings of a run."""
    content = f"{genotypes.shape} {genotypes.dtype}".encode() + genotypes.tobytes()
    return hashlib.sha256(content).hexdigest()


def _contents(source: StartFrom) -> tuple[PyTree, np.ndarray]:
    """Returns genotypes, leaves (cells, ...), and fitnesses (cells,) of an archive.

    Raises:
        ArchiveError: The file in the results folder is damaged.
        CheckpointError: The checkpoint in it is damaged, and it has no archive.
        ConfigError: It is no archive, or has several fitnesses in a cell.
    """
    if isinstance(source, str | os.PathLike):
        folder = Path(source)
        if not any((folder / name).is_file() for name in (CHECKPOINT, ARCHIVE)):
            why = "which has no archive"
            raise ConfigError(message("start_from", Fact(folder), _ALLOWED, why=why))
        source = read_archive(folder)
    source = getattr(source, "archive", source)
    if hasattr(source, "solution_dim"):  # of pyribs
        data = source.data(["solution", "objective"])
        return data["solution"], np.asarray(data["objective"], np.float32)
    if not hasattr(source, "genotypes") or not hasattr(source, "fitnesses"):
        raise ConfigError(message("start_from", source, _ALLOWED))
    fitnesses = np.asarray(source.fitnesses)
    if fitnesses.size != len(fitnesses):
        given = Fact(f"fitnesses of shape {fitnesses.shape}")
        raise ConfigError(message("start_from", given, "one fitness in each cell"))
    return source.genotypes, fitnesses.reshape(-1)


def _weights(genotypes: PyTree, policy: Policy) -> np.ndarray:
    """Returns weights (cells, size) from vectors or from parameters of a network.

    Raises:
        ConfigError: They are not weights of this policy.
    """
    rows = jax.ShapeDtypeStruct((policy.size,), jnp.float32)
    wanted = jax.eval_shape(policy.unravel, rows)
    leaves = jax.tree.leaves(genotypes)
    if jax.tree.structure(genotypes) == jax.tree.structure(wanted):
        expected = [leaf.shape for leaf in jax.tree.leaves(wanted)]
        if [leaf.shape[1:] for leaf in leaves] == expected:
            genotypes = jax.vmap(policy.ravel)(jax.tree.map(jnp.asarray, genotypes))
            leaves = [genotypes]
    shapes = [tuple(np.shape(leaf)) for leaf in leaves]
    if len(leaves) != 1 or shapes[0][1:] != (policy.size,):
        given = Fact(f"genotypes of shape {', '.join(map(str, shapes))}")
        allowed = f"(cells, {policy.size}), the weights of the policy of this run, or "
        allowed += "the parameters of its network"
        raise ConfigError(message("start_from", given, allowed))
    return np.asarray(leaves[0], np.float32)
