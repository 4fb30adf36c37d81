"""Writes pages: one HTML file with its scripts, styles and data inside.

A page opens from a disk without a network. Its Content-Security-Policy allows only the
scripts and the style sheet of the page itself, each by its hash. So a name in a URDF
file or in a configuration cannot run as code, and nothing is loaded from elsewhere.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import html
import importlib.resources
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from newton_qd.checks import Fact, message
from newton_qd.viewing.drawing import Drawing, DrawnShape
from newton_qd.viewing.sight import camera_offset
from newton_qd.viewing.trajectory import Trajectory

_PAGES = "newton_qd.viewing"
_LARGEST = 32767  # of int16
_THREE = "three.min.js"
_SHARED = (_THREE, "figure.js", "view.js", "player.js", "charts.js", "theme.js")


@functools.cache
def page_file(name: str) -> str:
    """Returns the text of a file in ``pages``.

    Args:
        name: Name of the file.

    Raises:
        OSError: The package was installed without it.
    """
    folder = importlib.resources.files(_PAGES) / "pages"
    return (folder / name).read_text(encoding="utf-8")


def page(title: str, body: str, scripts: Sequence[str], data: dict[str, Any]) -> str:
    """Returns a page.

    Args:
        title: Title in the window, any text.
        body: HTML of the body. It must be constant, without names from elsewhere.
        scripts: Names of the scripts in ``pages`` that use the shared ones.
        data: JSON value that the scripts read.

    Raises:
        OSError: The package was installed without its pages.
        ValueError: A number in ``data`` is not finite.
    """
    codes = [_script(name) for name in (*_SHARED, *scripts)]
    style = page_file("style.css")
    allowed = " ".join(_hash(code) for code in codes)
    policy = (
        f"default-src 'none'; script-src {allowed}; style-src {_hash(style)}; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title>",
        f"<style>{style}</style></head>",
        f"<body>{body}",
        f'<script type="application/json" id="data">{json_text(data)}</script>',
        *(f"<script>{code}</script>" for code in codes),
        "</body></html>",
    ]
    return "\n".join(parts) + "\n"


def _script(name: str) -> str:
    """Returns a script of the package that can be inside of HTML.

    Raises:
        ValueError: It has text that ends a script.
    """
    code = page_file(name)
    if "</script" in code.lower() or "<!--" in code:
        given = Fact("text that ends a script in a page")
        raise ValueError(message(f"pages/{name}", given, "none of it"))
    return code


def _hash(text: str) -> str:
    """Returns the hash of an inline script or style, as a policy names it."""
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def json_text(data: Any) -> str:
    """Returns JSON that can be inside of HTML.

    Args:
        data: A JSON value.

    Raises:
        ValueError: A number is not finite.
    """
    text = json.dumps(data, allow_nan=False, separators=(",", ":"), ensure_ascii=True)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def short(value: float) -> str:
    """Returns a number with four digits."""
    return f"{value:.4g}"


def encode(array: np.ndarray, kind: str = "float32") -> dict[str, Any]:
    """Returns an array as a JSON value that the pages decode.

    Args:
        array: The array.
        kind: ``"float32"``, ``"int32"``, ``"uint8"`` or ``"int16"``. Only the last
            one rounds floats: to 1 / 65,535 of the range of each component of the last
            axis.
    """
    array = np.asarray(array)
    found: dict[str, Any] = {"type": kind, "shape": list(array.shape)}
    if kind == "int16":
        flat = array.reshape(-1, array.shape[-1]).astype(np.float64)
        # an episode of one step has no rewards between two pictures
        some = flat if len(flat) else np.zeros((1, flat.shape[1]))
        low, high = some.min(axis=0), some.max(axis=0)
        offset = (low + high) / 2
        scale = np.maximum((high - low) / 2, 1e-9) / _LARGEST
        array = np.rint((flat - offset) / scale)
        found |= {"scale": scale.tolist(), "offset": offset.tolist()}
    little = np.dtype(kind).newbyteorder("<")
    found["data"] = base64.b64encode(array.astype(little).tobytes()).decode()
    return found


def drawing_data(drawing: Drawing) -> dict[str, Any]:
    """Returns a drawing as a JSON value."""
    return {
        "name": drawing.name,
        "body_names": list(drawing.body_names),
        "feet": list(drawing.feet),
        "parent": drawing.parent.tolist(),
        "joint_kind": drawing.joint_kind.tolist(),
        "q_start": drawing.q_start.tolist(),
        "joint_axis": drawing.joint_axis.tolist(),
        "parent_frame": drawing.parent_frame.tolist(),
        "child_frame": drawing.child_frame.tolist(),
        "nq": drawing.nq,
        "torso": drawing.torso,
        "shapes": [_shape_data(shape) for shape in drawing.shapes],
        "centre": drawing.centre.tolist(),
        "radius": drawing.radius,
        "camera": camera_offset(drawing).tolist(),
        "follow": drawing.follow,
        "grid": drawing.grid,
    }


def _shape_data(shape: DrawnShape) -> dict[str, Any]:
    """Returns a shape as a JSON value."""
    found = {
        "body": shape.body,
        "kind": shape.kind,
        "frame": shape.frame.tolist(),
        "size": shape.size.tolist(),
        "color": list(shape.color),
        "visual": shape.visual,
    }
    if shape.kind == "mesh":
        found["vertices"] = encode(shape.vertices)
        found["faces"] = encode(shape.faces, "int32")
    return found


def trajectory_data(trajectory: Trajectory) -> dict[str, Any]:
    """Returns a trajectory as a JSON value."""
    contacts = None
    if trajectory.contacts is not None:
        seen = trajectory.contacts
        contacts = {
            "body": seen.body.tolist(),
            "position": seen.position.tolist(),
            "radius": seen.radius.tolist(),
            "ground": seen.ground.tolist(),
            "impulse": encode(seen.impulse),
        }
    # a maze without physics counts time in steps
    unit = " s" if trajectory.dt != 1.0 else " steps"
    return {
        "drawing": drawing_data(trajectory.drawing),
        "dt": trajectory.dt,
        "unit": unit,
        "labels": list(trajectory.labels),
        "lengths": trajectory.lengths.tolist(),
        "q": encode(trajectory.q),
        "rewards": encode(trajectory.rewards),
        "descriptors": encode(trajectory.descriptors),
        "descriptor_names": list(trajectory.descriptor_names),
        "feet": encode(trajectory.feet > 0, "uint8"),
        "contacts": contacts,
    }
