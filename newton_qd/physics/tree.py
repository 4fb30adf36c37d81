"""Tables of a kinematic tree that the kernels walk: levels, paths, descendants."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from newton_qd.physics.system import JointKind, System


def _ragged(rows: Sequence[Sequence[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Starts and concatenated items of a list of lists (one item at least)."""
    starts = np.cumsum([0, *map(len, rows)], dtype=np.int32)
    items = [item for row in rows for item in row] or [0]
    return starts, np.asarray(items, np.int32)


def _by_level(level: Sequence[int]) -> list[list[int]]:
    """Items grouped by level, roots first."""
    return [
        [item for item, its in enumerate(level) if its == n]
        for n in range(max(level) + 1)
    ]


@dataclasses.dataclass(frozen=True)
class Tree:
    """Index tables of a system; bodies are counted from 1, row 0 is the world.

    Attributes:
        body_parent: (nb + 1,).
        body_level: Level starts and bodies, roots first.
        child: Child starts (nb + 2) and children of each body.
        body_dof: (nb + 1,) last degree of freedom on the way from the root, or -1.
        dof_body: (nv,) body that a degree of freedom moves first.
        dof_coordinate: (nv,) index in ``q``; -1 for the dofs of a free joint.
        depth: (nv,) number of dofs on the way from the root, itself included.
        path: (nv, max depth) dofs on the way from the root to the dof; padded by 0.
        descendant: Starts (nv + 1) and descendants of each dof.
        dof_level: Level starts and dofs, roots first.
        contact: Starts (nb + 2) of each body's contacts.
    """

    body_parent: np.ndarray
    body_level: tuple[np.ndarray, np.ndarray]
    child: tuple[np.ndarray, np.ndarray]
    body_dof: np.ndarray
    dof_body: np.ndarray
    dof_coordinate: np.ndarray
    depth: np.ndarray
    path: np.ndarray
    descendant: tuple[np.ndarray, np.ndarray]
    dof_level: tuple[np.ndarray, np.ndarray]
    contact: np.ndarray


def build_tree(system: System) -> Tree:
    """Index tables of ``system``."""
    nb, nv = system.nb, system.nv
    parent = [-1, *(int(p) + 1 for p in system.parent)]
    level = [-1]
    for body in range(1, nb + 1):
        level.append(level[parent[body]] + 1)
    levels = [[b + 1 for b in row] for row in _by_level(level[1:])]
    children = [[c for c in range(1, nb + 1) if parent[c] == b] for b in range(nb + 1)]

    v_end = [*system.v_start[1:], nv]
    last, dof_body, dof_parent, coordinate = [-1], [], [], []
    for body in range(1, nb + 1):
        previous = last[parent[body]]
        free = system.joint_kind[body - 1] == JointKind.FREE
        for k in range(system.v_start[body - 1], v_end[body - 1]):
            dof_body.append(body)
            dof_parent.append(previous)
            offset = k - system.v_start[body - 1]
            coordinate.append(-1 if free else system.q_start[body - 1] + offset)
            previous = k
        last.append(previous)

    paths: list[list[int]] = []
    for k in range(nv):
        paths.append([*(paths[dof_parent[k]] if dof_parent[k] >= 0 else []), k])
    depth = [len(path) for path in paths]
    path_table = np.zeros((nv, max(depth)), np.int32)
    for k, path in enumerate(paths):
        path_table[k, : len(path)] = path
    descendants = [[k for k in range(nv - 1, i, -1) if i in paths[k][:-1]] for i in range(nv)]
    contact_counts = np.bincount(system.contact_body + 1, minlength=nb + 1)
    return Tree(
        body_parent=np.asarray(parent, np.int32),
        body_level=_ragged(levels),
        child=_ragged(children),
        body_dof=np.asarray(last, np.int32),
        dof_body=np.asarray(dof_body, np.int32),
        dof_coordinate=np.asarray(coordinate, np.int32),
        depth=np.asarray(depth, np.int32),
        path=path_table,
        descendant=_ragged(descendants),
        dof_level=_ragged(_by_level([d - 1 for d in depth])),
        contact=np.asarray([0, *np.cumsum(contact_counts)], np.int32),
    )
