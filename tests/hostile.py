"""Hostile and broken files for ``test_fuzz.py``: strategies of hypothesis."""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from typing import Any

import numpy as np
from hypothesis import strategies as st

from newton_qd.assets import urdf_directory
from newton_qd.qd.config import EvolveConfig
from newton_qd.qd.run.archive import Archive, archive_bytes
from newton_qd.qd.run.checkpoint import npz_bytes

# Text.

ODD_NUMBERS = (
    "",
    "0",
    "-0",
    "1",
    "-1",
    "1e-320",
    "1e39",
    "1e308",
    "nan",
    "inf",
    "-inf",
)
ODD_NUMBERS += ("1 2", "1,5", "0x10", "1_0", "\u0661", "true", "${pi}", "1e999", "x")
NUMBERS = st.one_of(
    st.sampled_from(ODD_NUMBERS),
    st.floats(-3.0, 3.0, width=32).map(str),
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
)
OTHERS = st.sampled_from(["effort", "velocity"])
SOUND = st.floats(0.0625, 2.0, width=32).map(str)
NAMES = st.one_of(
    st.sampled_from(
        [
            "a",
            "b",
            "c",
            "d",
            "world",
            "",
            " ",
            "a'b",
            "a/b",
            "../a",
            "\u00e4",
            "a" * 300,
        ]
    ),
    st.text(st.characters(codec="utf-8", exclude_categories=("Cs", "Cc")), max_size=4),
)
PLACES = st.sampled_from(
    [
        "http://localhost:9/a.stl",
        "HTTPS://localhost:9/a.obj",
        "ftp://localhost:9/a.dae",
        "file:///etc/hostname",
        "file://localhost/etc/hostname",
        "/etc/hostname",
        "../../../../../../etc/hostname",
        "package://robot/a.stl",
        "package://../a.stl",
        "model://a/b.obj",
        "a.obj",
        "bad.stl",
        "evil.obj",
        "evil.dae",
        "a\x00b".replace("\x00", "%00"),
        "",
    ]
)
MESHES = {
    "a.obj": "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n",
    "bad.stl": "solid\nfacet",
    "evil.obj": "mtllib /etc/hostname\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    "evil.dae": "<COLLADA><image><init_from>http://localhost:9/a</init_from></image></COLLADA>",
}


def attribute(text: str) -> str:
    """Text as the value of an attribute."""
    for mark, name in (("&", "amp"), ("<", "lt"), ('"', "quot"), ("\n", "#10")):
        text = text.replace(mark, f"&{name};")
    return text


def element(tag: str, attributes: dict[str, str], inside: str = "") -> str:
    given = "".join(f' {k}="{attribute(v)}"' for k, v in attributes.items())
    return f"<{tag}{given}>{inside}</{tag}>"


# Robots.


@st.composite
def vectors(draw: st.DrawFn, odd: st.SearchStrategy[str]) -> str:
    count = draw(st.sampled_from([3] * 30 + [2, 4]))
    return " ".join(draw(odd) for _ in range(count))


@st.composite
def geometries(draw: st.DrawFn, numbers: st.SearchStrategy[str]) -> str:
    kind = draw(
        st.sampled_from(["sphere", "capsule", "cylinder", "box", "mesh", "mesh"])
    )
    sizes = {"radius": draw(numbers)}
    if kind in ("capsule", "cylinder"):
        sizes[draw(st.sampled_from(["length", "length", "height"]))] = draw(numbers)
    if kind == "box":
        sizes = {"size": draw(vectors(numbers))}
    if kind == "mesh":
        sizes = {"filename": draw(PLACES)}
        if draw(st.booleans()):
            sizes["scale"] = draw(vectors(NUMBERS))
    return element("geometry", {}, element(kind, sizes))


@st.composite
def links(draw: st.DrawFn, name: str, numbers: st.SearchStrategy[str]) -> str:
    parts = []
    if draw(st.sampled_from([True, True, True, False])):
        moment = draw(numbers)
        moments: dict[str, str] = dict.fromkeys(("ixx", "iyy", "izz"), moment)
        moments |= dict.fromkeys(("ixy", "ixz", "iyz"), "0")
        if draw(st.integers(0, 9)) == 0:
            moments[draw(st.sampled_from(sorted(moments)))] = draw(NUMBERS)
        mass = element("mass", {"value": draw(numbers)})
        parts.append(element("inertial", {}, mass + element("inertia", moments)))
    for role in draw(st.lists(st.sampled_from(["visual", "collision"]), max_size=2)):
        origin = element("origin", {"xyz": draw(vectors(numbers))})
        inside = origin + draw(geometries(numbers))
        if draw(st.integers(0, 5)) == 0:
            texture = element("texture", {"filename": draw(PLACES)})
            colour = element("color", {"rgba": draw(vectors(NUMBERS))})
            inside += element("material", {"name": draw(NAMES)}, texture + colour)
        parts.append(element(role, {}, inside))
    return element("link", {"name": name}, "".join(parts))


@st.composite
def robots(draw: st.DrawFn) -> str:
    """The text of a robot: a tree of links, sometimes with something wrong in it."""
    numbers = draw(st.sampled_from([SOUND] * 7 + [NUMBERS]))
    count = draw(st.integers(1, 5))
    plain = [f"l{i}" for i in range(count)]
    names = [draw(NAMES) if draw(st.integers(0, 19)) == 7 else x for x in plain]
    parts = [draw(links(name, numbers)) for name in names]
    kinds = ["revolute", "continuous", "prismatic", "fixed", "floating", "screw"]
    for index in range(1, count):
        parent = names[draw(st.integers(0, index - 1))]
        if draw(st.integers(0, 15)) == 0:
            parent = draw(NAMES)
        inside = element("parent", {"link": parent}) + element(
            "child", {"link": names[index]}
        )
        if draw(st.booleans()):
            inside += element("axis", {"xyz": draw(vectors(numbers))})
        if draw(st.booleans()):
            lower, upper = f"-{draw(numbers)}", draw(numbers)
            others = dict.fromkeys(draw(st.sets(OTHERS)), draw(NUMBERS))
            inside += element("limit", {"lower": lower, "upper": upper, **others})
        if draw(st.integers(0, 5)) == 0:
            inside += element("dynamics", {"damping": draw(numbers)})
        kind = draw(st.sampled_from(kinds[:4] * 5 + kinds[4:]))
        parts.append(element("joint", {"name": f"j{index}", "type": kind}, inside))
    shuffled = draw(st.permutations(parts)) if draw(st.booleans()) else parts
    name = draw(NAMES) if draw(st.booleans()) else "r"
    return element("robot", {"name": name}, "".join(shuffled))


SUITE = [
    path.read_text(encoding="utf-8")
    for path in sorted(urdf_directory().glob("*.urdf"))
    if path.name in ("ant.urdf", "hopper.urdf", "swimmer.urdf", "trap.urdf")
]


@st.composite
def changed_robots(draw: st.DrawFn) -> bytes:
    """A file of the suite with a few changes."""
    text = draw(st.sampled_from(SUITE))
    for _ in range(draw(st.integers(1, 4))):
        change = draw(st.sampled_from([0, 0, 0, 0, 1, 1, 2, 3, 4]))
        places = list(re.finditer(r'"([^"]*)"', text))
        if change <= 1 and places:  # another value
            place = draw(st.sampled_from(places))
            other = draw(st.one_of(NUMBERS, NAMES, PLACES))
            text = text[: place.start(1)] + attribute(other) + text[place.end(1) :]
        elif change == 2:  # an element that is gone, or that is there twice
            found = list(re.finditer(r"<\w+[^<>]*/>", text))
            if found:
                place = draw(st.sampled_from(found))
                times = draw(st.sampled_from([0, 2]))
                text = text[: place.start()] + place[0] * times + text[place.end() :]
        elif change == 3:  # another tag
            found = list(re.finditer(r"<(\w+)", text))
            place = draw(st.sampled_from(found))
            tag = draw(
                st.sampled_from(["joint", "link", "mesh", "robot", "origin", "x"])
            )
            text = text[: place.start(1)] + tag + text[place.end(1) :]
        elif draw(st.integers(0, 3)) == 0:  # other characters
            begin = draw(st.integers(0, len(text)))
            end = min(len(text), begin + draw(st.integers(0, 9)))
            text = text[:begin] + draw(st.text(max_size=4)) + text[end:]
    return text.encode("utf-8", "replace")


# Settings.

VALUES = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-(10**20), 10**20),
        st.floats(),
        st.text(max_size=6),
        st.sampled_from(["ant_uni", "me", "cma-me", "../../evil", 32, 0.5]),
    ),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.dictionaries(st.text(max_size=4), inner, max_size=2),
    ),
    max_leaves=4,
)
SETTINGS = st.dictionaries(
    st.one_of(st.sampled_from(sorted(vars(EvolveConfig()))), st.text(max_size=5)),
    VALUES,
    max_size=6,
)


def toml_value(value: Any) -> str:
    if isinstance(value, dict):
        inside = ", ".join(
            f"{json.dumps(k)} = {toml_value(v)}" for k, v in value.items()
        )
        return "{" + inside + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, float):
        return {"inf": "inf", "-inf": "-inf", "nan": "nan"}.get(str(value), repr(value))
    return json.dumps("" if value is None else value)


def toml_text(settings: dict[str, Any]) -> str:
    return "".join(f"{json.dumps(k)} = {toml_value(v)}\n" for k, v in settings.items())


@st.composite
def settings_files(draw: st.DrawFn) -> tuple[str, bytes]:
    """Name and content of a file of settings."""
    settings = draw(SETTINGS)
    if draw(st.booleans()):
        text = toml_text(settings)
        name = "settings.toml"
    else:
        document: Any = {"format": draw(st.sampled_from([1, 1, 1, 2, "1", None]))}
        document |= {"settings": settings, "environment": draw(st.just({}) | VALUES)}
        text = json.dumps(draw(st.sampled_from([document, settings, [], 3])))
        name = "config.json"
    content = text.encode("utf-8", "surrogatepass")
    return name, draw(damaged(content)) if draw(st.integers(0, 3)) == 0 else content


# Archives and checkpoints.


@st.composite
def damaged(draw: st.DrawFn, content: bytes) -> bytes:
    """The content with bytes that are other, gone or new."""
    for _ in range(draw(st.integers(1, 3))):
        begin = draw(st.integers(0, len(content)))
        end = min(len(content), begin + draw(st.sampled_from([0, 1, 1, 4, 100])))
        content = content[:begin] + draw(st.binary(max_size=4)) + content[end:]
    return content


SOUND_ARCHIVE = Archive(
    *(np.zeros(s, np.float32) for s in ((4, 3), (4,), (4, 2), (4, 2)))
)
PICKLE = np.array([{"a": 1}], dtype=object)


def with_header(header: str) -> bytes:
    """An array of NumPy whose header says anything."""
    text = header.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text


ARRAYS = st.one_of(
    st.sampled_from(
        [
            with_header(
                "{'descr': '<f4', 'fortran_order': False, 'shape': (10**12,), }"
            ),
            with_header("{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }"),
            with_header(
                "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000000000,), }"
            ),
            with_header("{'descr': '|O', 'fortran_order': False, 'shape': (1,), }"),
            with_header("__import__('os').system('touch evil')"),
            b"",
        ]
    ),
    st.binary(max_size=200),
)


def member(array: np.ndarray, *, pickled: bool = False) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, allow_pickle=pickled)
    return buffer.getvalue()


@st.composite
def archives(draw: st.DrawFn, content: bytes) -> bytes:
    """An archive of NumPy: damaged, or with other members than it should have."""
    if draw(st.booleans()):
        return draw(damaged(content))
    with zipfile.ZipFile(io.BytesIO(content)) as sound:
        members = {name: sound.read(name) for name in sound.namelist()}
    shapes = st.lists(st.integers(0, 5), max_size=3).map(tuple)
    kinds = st.sampled_from(["<f4", "<f8", "<i4", "|S3", "<U2", "?", "<c8", "<M8[s]"])
    for _ in range(draw(st.integers(1, 3))):
        name = draw(
            st.sampled_from([*members, "../evil.npy", "/tmp/evil.npy", "new.npy"])
        )
        kind = draw(st.integers(0, 3))
        if kind == 0:
            members.pop(name, None)
        elif kind == 1:
            members[name] = draw(ARRAYS)
        elif kind == 2:
            members[name] = member(PICKLE, pickled=True)
        else:
            members[name] = member(np.zeros(draw(shapes), draw(kinds)))
    buffer = io.BytesIO()
    method = draw(st.sampled_from([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED]))
    with zipfile.ZipFile(buffer, "w", method) as made:
        for name, data in members.items():
            made.writestr(name, data)
    return buffer.getvalue()


ARCHIVES = archives(archive_bytes(SOUND_ARCHIVE))
_FIELDS: dict[str, Any] = {
    "settings": "{}",
    "iteration": 0,
    "metrics": np.zeros((1, 7)),
    **vars(SOUND_ARCHIVE),
    "emitter_0": np.zeros(2),
}


@st.composite
def checkpoints(draw: st.DrawFn) -> bytes:
    """A checkpoint, most often with the digest that its content should have."""
    payload = npz_bytes(**{k: np.asarray(v) for k, v in _FIELDS.items()})
    payload = draw(archives(payload))
    digest = hashlib.sha256(payload).hexdigest().encode()
    content = b"newton_qd checkpoint 2 " + digest + b"\n" + payload
    return draw(damaged(content)) if draw(st.integers(0, 3)) == 0 else content
