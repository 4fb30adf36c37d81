"""Index tables of a kinematic tree."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from newton_qd.physics.system import System


def _ragged(rows: Sequence[Sequence[int]]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the row starts and the concatenated items of a list of lists.

    If there are no items, the result has one item 0.
    """
    starts = np.cumsum([0, *map(len, rows)], dtype=np.int32)
    items = [item for row in rows for item in row] or [0]
    return starts, np.asarray(items, np.int32)


def _by_level(level: Sequence[int]) -> list[list[int]]:
    """Returns the items grouped by level, roots first."""
    return [
        [item for item, its in enumerate(level) if its == n]
        for n in range(max(level) + 1)
    ]


@dataclasses.dataclass(frozen=True)
class Tree:
    """Index tables of a system. Bodies are counted from 1; row 0 is the world.

    Attributes:
        body_parent: (nb + 1,) parent of each body.
        body_level: Start of each level, and the bodies by level, roots first.
        child: (nb + 2,) start of each body's children, and the children.
        contact: (nb + 2,) start of each body's contacts.
    """

    body_parent: np.ndarray
    body_level: tuple[np.ndarray, np.ndarray]
    child: tuple[np.ndarray, np.ndarray]
    contact: np.ndarray


def build_tree(system: System) -> Tree:
    """Returns the index tables of ``system``."""
    nb = system.nb
    parent = [-1, *(int(p) + 1 for p in system.parent)]
    level = [-1]
    for body in range(1, nb + 1):
        level.append(level[parent[body]] + 1)
    levels = [[b + 1 for b in row] for row in _by_level(level[1:])]
    children = [[c for c in range(1, nb + 1) if parent[c] == b] for b in range(nb + 1)]

    contact_counts = np.bincount(system.contact_body + 1, minlength=nb + 1)
    return Tree(
        body_parent=np.asarray(parent, np.int32),
        body_level=_ragged(levels),
        child=_ragged(children),
        contact=np.asarray([0, *np.cumsum(contact_counts)], np.int32),
    )
