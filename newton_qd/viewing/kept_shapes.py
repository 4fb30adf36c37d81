"""Keeps the shapes of a URDF file, so that a page or a picture needs no Newton.

To import Newton takes two to three seconds, which is a third of ``newton-qd explore``.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from newton_qd.physics.cache import keep, kept, kernel_cache

if TYPE_CHECKING:
    import newton

_FOLDER = "newton_qd_shapes"
_PACKAGES = ("newton", "warp-lang")
_OTHER_FILES = (b"mesh", b"texture")
_FIELDS = 6  # of a row without points

Row = list[Any]
"""Body, kind, frame, size, colour and visibility; of a mesh also vertices and faces."""


def kept_or_read(
    path: Path, floats: bool, build: Callable[[], newton.ModelBuilder]
) -> list[Row]:
    """Returns the shapes of a file: what an earlier process kept, or new ones.

    A file that names others, such as meshes, is read each time. So is one whose entry
    is damaged.

    Args:
        path: The URDF file.
        floats: Whether its root link floats.
        build: Reads the file with Newton.

    Raises:
        OSError: The file cannot be read.
    """
    content = path.read_bytes()
    place = None
    if not any(word in content for word in _OTHER_FILES):
        place = _place(content, floats)
    if place is not None and (text := kept(place)) is not None:
        return json.loads(text)
    rows = list(map(list, _rows(build())))
    points = any(len(row) > _FIELDS for row in rows)
    if place is not None and not points:
        keep(place, json.dumps(rows).encode())
    return rows


def _place(content: bytes, floats: bool) -> Path | None:
    """Returns where the shapes are kept; ``None`` if Newton has no version."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        versions = [importlib.metadata.version(name) for name in _PACKAGES]
        digest = hashlib.sha256(repr((content, floats, *versions)).encode())
        own = Path(__file__)
        model = own.parent.parent / "physics" / "model"
        for file in (own, *sorted(model.glob("*.py"))):
            digest.update(file.read_bytes())
        return Path(kernel_cache()) / _FOLDER / f"{digest.hexdigest()[:32]}.shapes"
    return None


def _rows(builder: newton.ModelBuilder) -> list[Row]:
    """Returns the shapes that Newton has read."""
    from newton import GeoType, ShapeFlags

    kinds = {
        GeoType.SPHERE: "sphere",
        GeoType.CAPSULE: "capsule",
        GeoType.BOX: "box",
        GeoType.CYLINDER: "cylinder",
        GeoType.MESH: "mesh",
        GeoType.CONVEX_MESH: "mesh",
    }
    seen = {
        builder.shape_body[index]
        for index in range(builder.shape_count)
        if builder.shape_flags[index] & ShapeFlags.VISIBLE
    }
    rows = []
    for index in range(builder.shape_count):
        kind = kinds.get(GeoType(builder.shape_type[index]))
        if kind is None:
            continue
        mesh: Any = builder.shape_source[index] if kind == "mesh" else None
        points = []
        if mesh is not None:
            points.append(np.asarray(mesh.vertices, float).reshape(-1, 3))
            points.append(np.asarray(mesh.indices, np.int32).reshape(-1, 3))
        red, green, blue = (float(part) for part in builder.shape_color[index])
        body = int(builder.shape_body[index])
        rows.append(
            [
                body,
                kind,
                np.asarray(builder.shape_transform[index], float).tolist(),
                np.asarray(builder.shape_scale[index], float).tolist(),
                [red, green, blue, float(builder.shape_opacity[index])],
                # Newton hides the colliders of a robot if one link has a visual
                bool(builder.shape_flags[index] & ShapeFlags.VISIBLE)
                or body not in seen,
                *points,
            ]
        )
    return rows
