"""Settings of a run, config files, and packages that are missing."""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

import pytest
from point_runs import SMALL, run

from newton_qd.errors import MissingExtra, UnknownEnvironment
from newton_qd.qd.config import ConfigError, EvolveConfig, read_config
from newton_qd.qd.scoring.task import make_task
from newton_qd.robots import HOPPER

# QDax and what it imports warn about their own use of other packages.
pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"seed": -1}, "seed: got -1; allowed: integers from 0 to 4294967295"),
        ({"seed": 2**32}, "seed"),
        ({"seed": True}, "seed"),
        ({"iterations": -1}, "iterations: got -1; allowed: integers from 0"),
        ({"batch_size": 0}, "batch_size"),
        ({"batch_size": 2.0}, "batch_size"),
        ({"episode_length": 0}, "episode_length"),
        ({"hidden": (8, 0)}, "hidden"),
        ({"hidden": 8}, "hidden"),
        ({"grid": ()}, "grid"),
        ({"grid": (1, 1)}, "grid"),
        ({"grid": (5, -5)}, "grid"),
        ({"grid": (2000, 2000)}, "grid's number of cells"),
        ({"centroids": 1, "grid": None}, "centroids"),
        ({"centroids": 10, "grid": (5, 5)}, "grid, centroids: got .*one of"),
        ({"iso_sigma": float("nan")}, "iso_sigma"),
        ({"line_sigma": -0.1}, "line_sigma: got -0.1; allowed: finite number"),
        ({"tournament": 0}, "tournament: got 0; allowed: integers from 1 to 1000"),
        ({"env_name": ""}, "env_name"),
        ({"algorithm": 3}, "algorithm: got 3; allowed: text"),
        ({"options": 3}, "options: got 3; allowed: names with values"),
        ({"colour": "red"}, "setting: got 'colour'; allowed: algorithm, batch_"),
    ],
)
def test_bad_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        EvolveConfig().replace(**settings)


@pytest.mark.parametrize("seconds", ["5", None, True, -1.0, float("nan")])
def test_a_wrong_time_between_checkpoints_is_named(
    seconds: Any, tmp_path: Path
) -> None:
    text = r"^checkpoint_seconds: got .*; allowed: numbers from 0$"
    with pytest.raises(ConfigError, match=text):
        run(SMALL, out=tmp_path / "run", checkpoint_seconds=seconds)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["resume", "progress", "tensorboard"])
def test_a_wrong_flag_is_named(name: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"^{name}: got 'no'; allowed: True, False$"):
        run(SMALL, out=tmp_path / "run", **{name: "no"})
    assert not list(tmp_path.iterdir())


def test_a_grid_must_fit_the_descriptor(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(
        ConfigError, match=r"5x5x5, .* has 3 dimensions.*'point' has: 2"
    ):
        run(SMALL.replace(grid=(5, 5, 5)), out=out)
    assert not out.exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "no 'settings'"),
        ('{"format": 9, "settings": {}}', "format 9"),
        ('{"format": 1, "settings": []}', r"settings: got \[\]; allowed: an object"),
        (
            '{"format": 1, "settings": {"seed": "a"}}',
            "seed: got 'a'; allowed: integers",
        ),
        ('{"format": 1, "settings": {"sed": 1}}', "setting: got 'sed'"),
        ('{"format": 1, "settings": {"seed": 1}}', "env_name: got None"),
        (
            '{"format": 1, "settings": {}, "environment": {"packages": null}}',
            "environment: got .*facts by name",
        ),
    ],
)
def test_bad_config_files(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "config.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_config(path)
    assert str(path) in str(caught.value)


def test_equal_settings_have_equal_hashes() -> None:
    one, other = (
        EvolveConfig(env_options={"material": {"friction": friction}})  # pyright: ignore[reportArgumentType]
        for friction in (1, 1.0)
    )
    assert one == other and hash(one) == hash(other)


def test_missing_config_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read .*No such file"):
        read_config(tmp_path / "config.json")


@pytest.mark.parametrize(
    ("package", "extra"),
    [("qdax", "qd"), ("matplotlib", "viz"), ("tensorboardX", "tensorboard")],
)
def test_missing_extras(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    out = tmp_path / "run"
    with pytest.raises(MissingExtra, match=rf"{package}.*newton_qd\[{extra}\]"):
        run(out=out, tensorboard=True)
    assert not out.exists()


def test_names_that_are_no_task() -> None:
    with pytest.raises(UnknownEnvironment, match=r"'ant_unicorn'.*ant_uni"):
        make_task(EvolveConfig(env_name="ant_unicorn"))
    with pytest.raises(ConfigError, match=r"'ant', which has no descriptor.*ant_uni"):
        make_task(EvolveConfig(env_name="ant"))


def test_a_material_changes_what_it_names_and_a_final_place_is_named_so() -> None:
    options: Any = {"material": {"friction": 0.5}}
    task = make_task(EvolveConfig(env_name="hopper_uni", env_options=options))
    expected = dataclasses.replace(HOPPER.material, friction=0.5)
    assert task.env.unwrapped.robot.material == expected
    assert task.labels == ("foot contact",)
    task = make_task(EvolveConfig(env_name="pointmaze"))
    assert task.labels == ("final x", "final y")
