"""Finds the URDF files of the suite, in a checkout or in an installed wheel."""

from __future__ import annotations

import os
from pathlib import Path

from newton_qd.checks import Fact, listed, message

_PACKAGE = Path(__file__).resolve().parent


class AssetNotFoundError(FileNotFoundError):
    """A file that a robot or a scene names does not exist."""


def urdf_directory() -> Path:
    """Returns the folder that holds the URDF files of the suite.

    Raises:
        AssetNotFoundError: The package was installed without its URDF files.
    """
    installed = _PACKAGE / "urdf"
    checkout = _PACKAGE.parent / "urdf"
    if installed.is_dir():
        return installed
    # Beside an installed package, a folder of this name belongs to another project.
    if checkout.is_dir() and (_PACKAGE.parent / "pyproject.toml").is_file():
        return checkout
    raise AssetNotFoundError(
        f"the URDF files of newton_qd are missing: neither {installed} nor a "
        f"checkout's {checkout} exists; install the package again"
    )


def find_urdf(name: str | os.PathLike[str]) -> Path:
    """Returns the path of a URDF file.

    Args:
        name: File name inside the suite's ``urdf/``, or a path. A path object is a
            path, and so is text with a folder in it, such as ``"./mine.urdf"``.

    Raises:
        AssetNotFoundError: The file does not exist.
    """
    text = os.fspath(name)
    separators = [os.sep] + ([os.altsep] if os.altsep else [])
    if not isinstance(name, str) or any(mark in text for mark in separators):
        path = Path(text).expanduser()
        if not path.is_file():
            given = Fact(f"{text!r}, where no file is ({path.absolute()})")
            raise AssetNotFoundError(message("urdf", given, "a file that exists"))
        return path
    folder = urdf_directory()
    path = folder / text
    if not text or not path.is_file():
        known = listed(sorted(file.name for file in folder.glob("*.urdf")))
        allowed = f"{known}, or a path with a folder in it, such as './mine.urdf'"
        why = f"which is no file in {folder}"
        raise AssetNotFoundError(message("urdf", text, allowed, why=why))
    return path
