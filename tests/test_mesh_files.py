"""Newton's viewers get only the meshes below the folder of a URDF file."""

from __future__ import annotations

import warnings
from pathlib import Path

import pytest
from urdf_text import link, robot_text, row, write

from newton_qd.physics.model import (
    RobotDescriptionError,
    RobotDescriptionWarning,
    build_system,
    newton_builder,
)
from newton_qd.viewing.drawing import drawing_of_system

pytestmark = pytest.mark.usefixtures("no_network")

CORNER = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
PLY = """ply\nformat ascii 1.0\ncomment TextureFile ../secret.png\nelement vertex 3
property float x\nproperty float y\nproperty float z\nelement face 1
property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"""
DAE = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema">
<library_images><image id="i"><init_from>{}</init_from></image></library_images>
</COLLADA>"""


def drawn(tag: str, filename: str) -> str:
    return robot_text(
        link("a", f'<{tag}><geometry><mesh filename="{filename}"/></geometry></{tag}>')
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with meshes, beside files that nobody gave."""
    inside = tmp_path / "robot"
    inside.mkdir()
    files = {
        "secret.obj": CORNER,
        "secret.mtl": "newmtl m\nmap_Kd secret.png\n",
        "pack/meshes/a.obj": CORNER,
        "robot/a.obj": f"mtllib a.mtl\n{CORNER}",
        "robot/a.mtl": "newmtl m\nKd 1 0 0\n",
        "robot/bad.obj": "f 1 2 3\n",
        "robot/empty.stl": "",
        "robot/a.txt": CORNER,
        "robot/lib.obj": f"mtllib ../secret.mtl\n{CORNER}",
        "robot/map.obj": f"mtllib map.mtl\n{CORNER}",
        "robot/map.mtl": "newmtl m\n  map_Kd -s 1 1 1 /etc/hostname\n",
        "robot/address.obj": f"mtllib address.mtl\n{CORNER}",
        "robot/address.mtl": "newmtl m\nmap_Kd http://localhost:9/a.png\n",
        "robot/a.ply": PLY,
        "robot/address.dae": DAE.format("https://localhost:9/a.png"),
        "robot/outside.dae": DAE.format("../secret.png"),
        "robot/broken.dae": "<COLLADA",
    }
    for name, text in files.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    (inside / "link.obj").symlink_to(tmp_path / "secret.obj")
    return inside


REFUSED = {
    "http://localhost:9/a.obj": "allowed: files below",
    "HTTPS://localhost:9/a.obj": "allowed: files below",
    "ftp://localhost:9/a.obj": "allowed: files below",
    "../secret.obj": "allowed: files below",
    "link.obj": "allowed: files below",
    "package://pack/meshes/a.obj": "or below a folder given as packages=",
    "absent.obj": "allowed: files below",
    "a.txt": "which is none of .stl, .obj, .dae, .ply",
    "bad.obj": "which Newton cannot read",
    "empty.stl": "which Newton cannot read",
    "lib.obj": "which names the file '../secret.mtl'",
    "map.obj": "which names the file '/etc/hostname'",
    "address.obj": "which names the file 'http://localhost:9/a.png'",
    "a.ply": "which names the file '../secret.png'",
    "address.dae": "which names the file 'https://localhost:9/a.png'",
    "outside.dae": "which names the file '../secret.png'",
    "broken.dae": "which cannot be read",
}


@pytest.mark.parametrize("name", REFUSED)
def test_meshes_that_are_not_read(name: str, folder: Path) -> None:
    path = write(folder, drawn("visual", name))
    with pytest.warns(RobotDescriptionWarning, match=REFUSED[name]) as caught:
        assert newton_builder(path, True, 9.81).shape_count == 0
    assert f"{path}, line 3, <mesh>: filename: got {name}" in str(caught[0].message)
    path = write(folder, drawn("collision", name))
    with pytest.raises(RobotDescriptionError, match=REFUSED[name]) as error:
        newton_builder(path, True, 9.81)
    text = f"{path}, line 3, <mesh>: filename of a collider's mesh: got {name!r}"
    assert text in str(error.value)


def test_meshes_that_are_read(folder: Path) -> None:
    own, pack = folder.as_uri(), folder.parent / "pack"
    cases = [("a.obj", ()), (f"{own}/a.obj", ()), ("package://robot/a.obj", ())]
    package = "package://pack/meshes/a.obj"
    cases += [(package, (pack,)), (package, (str(folder.parent),))]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name, packages in cases:
            path = write(folder, drawn("visual", name))
            builder = newton_builder(path, True, 9.81, packages=packages)
            assert builder.shape_count == 1, name


@pytest.mark.parametrize("name", ["package://pack/meshes/a.obj", "../meshes/a.obj"])
def test_meshes_of_the_own_package_are_read(name: str, folder: Path) -> None:
    """A package of ROS has its URDF files in one folder, and its meshes in another."""
    inside = folder.parent / "pack" / "urdf"
    inside.mkdir()
    path = write(inside, drawn("collision", name))
    with pytest.raises(RobotDescriptionError, match="allowed: files below"):
        newton_builder(path, True, 9.81)
    (inside.parent / "package.xml").touch()
    assert newton_builder(path, True, 9.81).shape_count == 1
    path = write(inside, drawn("collision", "../../secret.obj"))
    with pytest.raises(RobotDescriptionError, match="allowed: files below"):
        newton_builder(path, True, 9.81)


def test_the_package_around_the_working_directory_is_another_one(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The path of a file may lead out of a package, as ../train/robot.urdf does."""
    write(folder, drawn("collision", "a.obj"))
    package = folder.parent / "pack"
    (package / "package.xml").touch()
    monkeypatch.chdir(package)
    path = f"../{folder.name}/robot.urdf"
    assert newton_builder(path, True, 9.81).shape_count == 1
    write(folder, drawn("collision", "../pack/meshes/a.obj"))
    with pytest.raises(RobotDescriptionError, match="allowed: files below"):
        newton_builder(path, True, 9.81)


def test_a_colour_is_checked(folder: Path) -> None:
    colour = '<material name="m"><color rgba="1 red 0 1"/></material>'
    path = write(folder, robot_text(colour, link("a")))
    with pytest.raises(RobotDescriptionError, match="<color>: rgba: got '1 red 0 1'"):
        newton_builder(path, True, 9.81)
    assert newton_builder(path, True, 9.81, False).body_count == 1
    opaque = colour.replace("1 red 0 1", "1 0 0")
    path = write(folder, robot_text(opaque, link("a")))
    assert newton_builder(path, True, 9.81).body_count == 1


def test_a_robot_is_drawn_without_a_mesh_that_is_not_read(folder: Path) -> None:
    """A mesh beside the folder trains: nothing touches it. So a page must show it."""
    ball = "<collision><geometry><sphere radius='0.1'/></geometry></collision>"
    text = drawn("collision", "../secret.obj").replace("</link>", f"{ball}</link>")
    system = build_system(row(write(folder, text), "a"), "float32")
    with pytest.warns(RobotDescriptionWarning, match="another one is not drawn"):
        (shape,) = drawing_of_system(system).shapes
    assert shape.kind == "sphere" and shape.visual
