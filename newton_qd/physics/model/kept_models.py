"""Keeps what Newton built from a file, so that the next process starts faster.

To import Newton takes two to three seconds, which is half of the time that the first
``create`` of a process takes. Newton gets nothing but the text of the file and two
numbers. So its answer is kept in the folder of compiled kernels, under a hash of these,
of the versions of Newton and Warp, and of the code of this folder. What was kept is
compared with the file again, as if Newton had just built it.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

from newton_qd.physics.cache import keep, kept, kernel_cache
from newton_qd.physics.model.description import Description
from newton_qd.physics.model.elements import Shape
from newton_qd.physics.model.newton_input import NewtonInput
from newton_qd.physics.model.verify import BuiltModel, ModelMismatchError, verify

_FOLDER = "newton_qd_models"
_PACKAGES = ("newton", "warp-lang")
_NAMES = ("body_names", "joint_names")
_ARRAYS = (
    *("parent", "joint_kind", "q_start", "v_start", "parent_frame", "child_frame"),
    *("axis", "lower", "upper", "damping", "mass", "com", "inertia"),
)


def kept_or_built(
    description: Description, gravity: float, build: Callable[[], BuiltModel]
) -> BuiltModel:
    """Returns Newton's model of a file: what an earlier process kept, or a new one.

    A file that is damaged, or does not equal the robot, is replaced. A folder that
    cannot be written is no error: then nothing is kept.

    Args:
        description: The robot in the file.
        gravity: Downward acceleration [m/s^2].
        build: Builds the model with Newton, and compares it with the file.
    """
    path = _path(description, gravity)
    if path is not None and (found := _read(path)) is not None:
        with contextlib.suppress(ModelMismatchError):
            verify(found, description)
            return found
    model = build()
    if path is not None:
        _write(path, model)
    return model


def _path(description: Description, gravity: float) -> Path | None:
    """Returns where the model is kept; ``None`` if Newton has no version."""
    try:
        versions = [importlib.metadata.version(name) for name in _PACKAGES]
    except importlib.metadata.PackageNotFoundError:
        return None
    text = NewtonInput(Path(description.path), False, ()).text()
    code = [file.read_bytes() for file in sorted(Path(__file__).parent.glob("*.py"))]
    given = (text, description.floating, gravity, *versions)
    digest = hashlib.sha256(repr(given).encode())
    for content in code:
        digest.update(content)
    return Path(kernel_cache()) / _FOLDER / f"{digest.hexdigest()[:32]}.model"


def _read(path: Path) -> BuiltModel | None:
    """Returns a model that was kept; ``None`` without a complete one."""
    if (content := kept(path)) is None:
        return None
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    shapes: list[list[Shape]] = [[] for _ in arrays["mass"]]
    columns = [arrays[f"shape_{name}"] for name in ("body", "kind", "frame", "size")]
    for body, kind, frame, size in zip(*columns, strict=True):
        shapes[body].append(Shape("", str(kind), frame, size))
    return BuiltModel(
        **{name: tuple(arrays[name].tolist()) for name in _NAMES},
        **{name: arrays[name] for name in _ARRAYS},
        shapes=tuple(map(tuple, shapes)),
    )


def _write(path: Path, model: BuiltModel) -> None:
    """Keeps a model, if the folder can be written."""
    shapes = [(body, x) for body, found in enumerate(model.shapes) for x in found]
    file = io.BytesIO()
    np.savez(
        file,
        shape_body=np.array([body for body, _ in shapes], dtype=np.int32),
        shape_kind=np.array([x.kind for _, x in shapes], dtype=np.str_),
        shape_frame=np.array([x.frame for _, x in shapes]).reshape(-1, 7),
        shape_size=np.array([x.size for _, x in shapes]).reshape(-1, 3),
        **{name: np.array(getattr(model, name), dtype=np.str_) for name in _NAMES},
        **{name: getattr(model, name) for name in _ARRAYS},
    )
    keep(path, file.getvalue())
