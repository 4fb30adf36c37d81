"""Which files a URDF file may have read: those of its folder, package or a given one.

A mesh or a texture is read for Newton's viewers only. A URDF file of somebody else must
cause no request in a network, and must not read a file elsewhere on this machine. That
holds for the files that a mesh names, too.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree

from newton_qd.checks import listed

READABLE = (".stl", ".obj", ".dae", ".ply")
"""Kinds of mesh files that are read: all that may name other files in known places."""

_OBJ_FILES = re.compile(
    rb"^\s*(?:mtllib|map_\w+|bump|disp|decal|refl|norm)[ \t]+([^\r\n]*)", re.MULTILINE
)
_PLY_FILES = re.compile(rb"^\s*comment\s+TextureFile\s+([^\r\n]*)", re.MULTILINE)
_DAE_TAGS = ("init_from", "ref")


def places(urdf: Path, name: str, packages: Sequence[Path] = ()) -> list[Path]:
    """Returns where the file is that a URDF file names; empty if nowhere here.

    Args:
        urdf: The URDF file.
        name: A path, relative to the file's folder, or ``file:///path``, or
            ``package://NAME/path`` with a folder NAME that contains the URDF file.
        packages: Folders of packages, or folders that contain some.
    """
    base = urdf.absolute().parent
    scheme, mark, rest = name.partition("://")
    if not mark:
        return [base / name]
    if scheme.lower() == "file":
        return [Path(unquote(urlsplit(name).path))]
    if scheme.lower() not in ("package", "model"):
        return []
    package, _, inside = rest.partition("/")
    named = [f for f in (base, *base.parents, *packages) if f.name == package]
    return [*(folder / inside for folder in named), *(f / rest for f in packages)]


class Folders:
    """The folders of which a URDF file may have files read.

    Attributes:
        allowed: Description of the allowed files, for errors.
    """

    def __init__(self, urdf: Path, packages: Sequence[str | Path] = ()):
        self._urdf = urdf.absolute()
        self._packages = [Path(package).expanduser().absolute() for package in packages]
        roots = [*(_own_package(self._urdf) or [self._urdf.parent]), *self._packages]
        self._roots = [root.resolve() for root in roots]
        below = listed(roots)
        self.allowed = f"files below {below}, or below a folder given as packages=..."

    def file(self, name: str) -> Path | None:
        """Returns the file that a URDF file names, or ``None`` if it is not allowed."""
        found = places(self._urdf, name, self._packages)
        return next((place for place in found if self._is_file(place)), None)

    def problem(self, mesh: Path) -> str:
        """Returns why the file of a mesh may not be read; empty if it may."""
        if mesh.suffix.lower() not in READABLE:
            return f"which is none of {listed(READABLE)}"
        try:
            outside = self._outside(mesh)
        except (OSError, ElementTree.ParseError) as error:
            return f"which cannot be read ({error})"
        return "" if outside is None else f"which names the file {outside!r}"

    def _outside(self, mesh: Path) -> str | None:
        """Returns a name in a mesh file of a file that is not allowed."""
        pending = [mesh]
        for file in pending:
            for name in _named(file):
                # Options may stand before the name of a map: each word may be a name.
                for part in dict.fromkeys((name, *name.split())):
                    found = file.parent / part
                    if "://" in part or not self._is_inside(found):
                        return part
                    if found.suffix.lower() == ".mtl" and found not in pending:
                        pending += [found] if found.is_file() else []
        return None

    def _is_inside(self, path: Path) -> bool:
        # Follows links, as a link may lead outside.
        try:
            real = path.resolve()
        except (OSError, RuntimeError, ValueError):  # a loop of links, a zero byte
            return False
        return any(real.is_relative_to(root) for root in self._roots)

    def _is_file(self, path: Path) -> bool:
        return self._is_inside(path) and path.is_file()


def _own_package(urdf: Path) -> list[Path]:
    """Returns the nearest folder around a URDF file that is a package of ROS.

    There, the file is in a folder such as urdf/, and its meshes are beside this folder.
    """
    # resolved, because b of a/../b/robot.urdf is not in a
    inside = urdf.parent.resolve()
    around = (inside, *inside.parents)
    return [folder for folder in around if (folder / "package.xml").is_file()][:1]


def _named(file: Path) -> list[str]:
    """Returns the names of the files that a mesh file or its materials name."""
    kind = file.suffix.lower()
    if kind == ".stl":
        return []
    data = file.read_bytes()
    if kind == ".dae":
        found = [
            element.text or ""
            for element in ElementTree.fromstring(data).iter()
            if element.tag.rpartition("}")[2] in _DAE_TAGS
        ]
    else:
        pattern = _PLY_FILES if kind == ".ply" else _OBJ_FILES
        found = [name.decode("utf-8", "replace") for name in pattern.findall(data)]
    return [name.strip() for name in found]
