"""Environment options, modules, versions and help of the command line."""

from __future__ import annotations

import argparse
import dataclasses
import runpy
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import processes
import pytest
from point_runs import SMALL, point_task

import newton_qd
from newton_qd import cli
from newton_qd.cli.evolve_arguments import add_arguments, settle
from newton_qd.qd import register_algorithm
from newton_qd.qd.algorithms import ALGORITHMS, algorithm_named, algorithms
from newton_qd.qd.config import (
    ConfigError,
    EvolveConfig,
    config_to_json,
    read_config,
)
from newton_qd.qd.facts import environment_facts
from newton_qd.qd.run.evolution import evolve
from newton_qd.qd.scoring.task import make_task
from newton_qd.qd.study import study_config
from newton_qd.scenes import MAZE

TESTS = Path(__file__).resolve().parent
POINT = ["evolve", "point", "--quiet", "--iterations", "1", "--batch-size", "16"]
POINT += ["--episode-length", "9", "--hidden", "4", "--grid", "4x4"]
POINT += ["--reevaluations", "0"]


class Seen(Exception):  # noqa: N818 - it only stops the command
    def __init__(self, config: EvolveConfig) -> None:
        self.config = config


def stop(config: EvolveConfig) -> Any:
    raise Seen(config)


def settings(*arguments: str) -> EvolveConfig:
    """The settings that arguments make."""
    with pytest.raises(Seen) as seen:
        cli.main([*POINT, *arguments], task_factory=stop)
    return seen.value.config


def test_the_backend_of_a_run_is_that_of_its_device(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also of ``evolve(..., device="cpu")`` where JAX's own choice is a GPU."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    with jax.default_device(jax.devices("cpu")[0]):
        assert environment_facts()["backend"] == "cpu"


def test_options_of_the_environment_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    options = ["healthy_reward=0.5", "terminate_when_unhealthy=false", "scene=maze"]
    options += ["material.friction=0.8", "healthy_z_range=[0.1, 2]", "a.b.c=None"]
    arguments = [part for text in options for part in ("--env-option", text)]
    expected = {
        "healthy_reward": 0.5,
        "terminate_when_unhealthy": False,
        "scene": "maze",
        "material": {"friction": 0.8},
        "healthy_z_range": (0.1, 2),
        "a": {"b": {"c": None}},
    }
    config = settings(*arguments)
    assert dict(config.env_options) == expected
    # also from files, which arguments complete
    path = tmp_path / "config.json"
    path.write_text(config_to_json(config, environment_facts()))
    assert read_config(path)[0] == config and hash(config) == hash(config)
    more = ["--config", str(path), "--env-option", "material.smoothing=0.01"]
    table = dict(settings(*more).env_options)["material"]
    assert table == {"friction": 0.8, "smoothing": 0.01}
    toml = tmp_path / "run.toml"
    toml.write_text(
        'env_name = "point"\n[env_options]\nhealthy_reward = 0.5\n'
        "qdax_wrappers_kwargs = [{minval = [-1, -1]}]\n"
        "[env_options.material]\nfriction = 0.8\n"
    )
    found = dict(settings("--config", str(toml)).env_options)
    assert found["material"] == {"friction": 0.8}
    assert found["qdax_wrappers_kwargs"] == ({"minval": (-1, -1)},)


UNSETTABLE = """
env_name = "point"
new_starts = true
seed = 3
centroids = 9
[options]
noise = 0.1
samples = 4
[randomize]
friction = [0.5, 1.5]
[env_options]
healthy_reward = 0.5
[env_options.material]
friction = 0.8
smoothing = 0.01
"""


def test_settings_of_a_file_get_their_defaults_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("run.toml").write_text(UNSETTABLE)
    names = ["new_starts", "seed", "options.noise", "randomize", "centroids"]
    names += ["env_options.material.friction", "env_options.healthy_reward"]
    parser = argparse.ArgumentParser()
    add_arguments(parser.add_subparsers(), lambda *_: 0)
    unset = [part for name in names for part in ("--unset", name)]
    base = ["evolve", "--config", "run.toml"]
    config, out = settle(parser.parse_args([*base, *unset]))
    assert config == EvolveConfig(env_name="point").replace(
        options={"samples": 4}, env_options={"material": {"smoothing": 0.01}}
    )
    assert out == Path("results/point-seed0")
    # what is given holds
    more = [*base, "--unset", "options", "--option", "noise=0.2", "--seed", "4"]
    config, out = settle(parser.parse_args([*more, "--unset", "seed"]))
    assert dict(config.options) == {"noise": 0.2} and config.seed == 4
    # without its last entry, a table is that of the default: none
    more = [
        f"--unset=env_options.material.{name}" for name in ("friction", "smoothing")
    ]
    config, _ = settle(parser.parse_args([*base, *more]))
    assert dict(config.env_options) == {"healthy_reward": 0.5}


@pytest.mark.parametrize(
    ("name", "allowed"),
    [
        ("env_name", "algorithm, .*warm_start$"),
        ("seed.x", "seed, or entries of options, env_options, randomize$"),
        ("options.nosie", "entries of options: noise, samples$"),
        ("options.noise.x", "entries of options.noise: none$"),
        ("env_options.material.x", "entries of env_options.material: friction, smo"),
        (None, "only with --config or --study, whose settings it takes back"),
    ],
)
def test_settings_that_cannot_be_unset_are_named(
    name: str | None, allowed: str, tmp_path: Path
) -> None:
    (path := tmp_path / "run.toml").write_text(UNSETTABLE)
    base = ["evolve", "point", "--unset", name or "seed"]
    base += [] if name is None else ["--config", str(path)]
    parser = argparse.ArgumentParser()
    add_arguments(parser.add_subparsers(), lambda *_: 0)
    with pytest.raises(ConfigError, match=f"^unset: got .*; allowed: {allowed}"):
        settle(parser.parse_args(base))


def test_settings_of_the_study_are_a_base(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ["evolve", "hopper_uni", "--algorithm", "me-actor-critic", "--study"]
    arguments += ["--quiet", "--iterations", "9", "--option", "copies=8"]
    with pytest.raises(Seen) as seen:
        cli.main([*arguments, "--grid", "64"], task_factory=stop)
    base = study_config("hopper_uni", "me-actor-critic")
    options = {**dict(base.options), "copies": 8}
    changes = {"iterations": 9, "options": options, "grid": (64,), "centroids": None}
    assert seen.value.config == base.replace(**changes)
    assert base.starts == 16 and options["actors"] == 16


def test_a_resumed_run_of_the_study_keeps_its_generations(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    kept = study_config("hopper_uni").replace(iterations=250)
    Path("run").mkdir()
    Path("run", "config.json").write_text(config_to_json(kept, environment_facts()))
    arguments = ["evolve", "hopper_uni", "--study", "--resume", "--out", "run"]
    parser = argparse.ArgumentParser()
    add_arguments(parser.add_subparsers(), lambda *_: 0)
    for more, iterations in (([], 250), (["--iterations", "300"], 300)):
        config, _ = settle(parser.parse_args([*arguments, *more]))
        assert config == kept.replace(iterations=iterations)


def test_a_resumed_run_of_the_study_knows_what_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    arguments = ["evolve", "--study", "--resume", "--quiet", "--out", str(out)]
    assert cli.main(arguments) == cli.BAD_ARGUMENTS
    assert f"out: got {out}, which holds no run" in capsys.readouterr().err
    for more in ([], ["--unset", "starts"]):
        assert cli.main(["evolve", "--study", "--quiet", *more]) == cli.BAD_ARGUMENTS
        assert "ENV: got None" in capsys.readouterr().err
    kept = study_config("hopper_uni", "me-actor-critic").replace(iterations=250)
    out.mkdir()
    (out / "config.json").write_text(config_to_json(kept, environment_facts()))
    with pytest.raises(Seen) as seen:
        cli.main(arguments, task_factory=stop)
    assert seen.value.config == kept
    for wrong, said in (
        ("antmaze", "env_name: got 'antmaze'; allowed: 'hopper_uni', as the run in"),
        ("--algorithm=me-es", "algorithm: got 'me-es'; allowed: algorithms of the st"),
    ):
        assert cli.main([*arguments, wrong]) == cli.BAD_ARGUMENTS
        assert said in capsys.readouterr().err


def test_cells_replace_those_of_a_config(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # without --out, which has its own way
    for base, cells in (
        (SMALL, ("--centroids", "100")),
        (SMALL.replace(grid=None, centroids=9), ("--grid", "3x5")),
    ):
        path = tmp_path / "config.json"
        path.write_text(config_to_json(base, environment_facts()))
        for out in ([], ["--out", "run"]):
            arguments = ["evolve", "--quiet", "--config", str(path), *cells, *out]
            with pytest.raises(Seen) as seen:
                cli.main(arguments, task_factory=stop)
            config = seen.value.config
            expected = (None, 100) if base is SMALL else ((3, 5), None)
            assert (config.grid, config.centroids) == expected


def test_ranges_are_added_to_those_of_a_config(tmp_path: Path) -> None:
    ranges: Any = {"friction": (0.5, 1.5)}
    kept = EvolveConfig(env_name="hopper_uni", randomize=ranges)
    path = tmp_path / "config.json"
    path.write_text(config_to_json(kept, environment_facts()))
    parser = argparse.ArgumentParser()
    add_arguments(parser.add_subparsers(), lambda *_: 0)
    arguments = ["evolve", "--config", str(path), "--randomize", "gravity=9,10"]
    config, _ = settle(parser.parse_args(arguments))
    assert dict(config.randomize) == {**ranges, "gravity": (9.0, 10.0)}


def test_options_are_written_as_in_json_or_in_python(
    capsys: pytest.CaptureFixture[str],
) -> None:
    parser = argparse.ArgumentParser()
    add_arguments(parser.add_subparsers(), lambda *_: 0)
    given = ("conditioned=false", "whiten=False", "critic=[8,8]", "rate=1e-3")
    arguments = ["evolve", "pointmaze"]
    for option in given:
        arguments += ["--option", option]
    config, _ = settle(parser.parse_args(arguments))
    expected = {"conditioned": False, "whiten": False, "critic": (8, 8), "rate": 1e-3}
    assert dict(config.options) == expected
    deep = f"critic={'[' * 20_000}"
    for wrong in ("conditioned", "=1", "conditioned=no", "conditioned='no'", deep):
        with pytest.raises(SystemExit):
            parser.parse_args(["evolve", "pointmaze", "--option", wrong])
        assert "allowed: a name and a value like" in capsys.readouterr().err


def test_wrong_options_of_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    ant = ["evolve", "ant_uni", "--env-option"]
    for option, text in (
        ("healthy_rewrd=1", "'ant_uni'; allowed: those of create, and ctrl_cost_wei"),
        ("healthy_reward=high", "env_options: healthy_reward: got 'high'; allowed"),
        ("batch_size=3", "got 'batch_size', which evolve sets itself; allowed"),
        ("material=3", "material: got 3; allowed: a table of fields of Material"),
        ("material.colour=3", "unexpected keyword argument 'colour'"),
        ("material.frictio=1", "env_options: material.frictio: got 1, an unexpected k"),
        ("material.frictio=1", "; allowed: friction, static_penetration, support"),
        ("scene.name=x", "scene: got a table without 'urdf'; allowed: a table with"),
        ("scene.colour=x", "scene.colour: got 'x', an unexpected keyword argument"),
        ("qdax_wrappers_kwargs=[{'smooth': 1}]", "_kwargs[0], smooth: got 1, which is"),
        ("qdax_wrappers_kwargs=[{}, {}]", "got 2 entries; allowed: None, or 1 for"),
        ("fixed_init_state=3", "fixed_init_state: got 3"),
    ):
        assert cli.main([*ant, option]) == cli.BAD_ARGUMENTS, option
        assert text in capsys.readouterr().err
    point = ["evolve", "pointmaze", "--env-option", "material.friction=1"]
    assert cli.main(point) == cli.BAD_ARGUMENTS
    assert "env_options: " in capsys.readouterr().err
    assert cli.main([*ant[:2], "--randomize", "fric=1,2"]) == cli.BAD_ARGUMENTS
    error = capsys.readouterr().err
    assert "randomize: fric: got (1.0, 2.0), which is no physical parameter; " in error
    assert "allowed: gravity, friction, " in error
    assert not list(tmp_path.iterdir())
    with pytest.raises(SystemExit):
        cli.main([*ant, "healthy_reward"])
    assert "a name and a value like healthy_reward=0.5" in capsys.readouterr().err
    numbers: Any = {"sigma_g": np.float32(0.5), "n": np.int64(3)}
    plain = EvolveConfig(options=numbers)
    assert plain.options == (("n", 3), ("sigma_g", 0.5))
    assert type(plain.options[0][1]) is int and type(plain.options[1][1]) is float
    with pytest.raises(ConfigError, match=r"options: a: got an array"):
        EvolveConfig(options={"a": np.zeros(2)})  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"env_options: a\[1\]: got <object"):
        EvolveConfig(env_options={"a": [1, object()]})  # type: ignore[arg-type]


@pytest.mark.slow
def test_options_reach_the_environment() -> None:
    options = {"healthy_reward": 0.25, "material": {"friction": 0.5}}
    options |= {"fixed_init_state": True}
    config = EvolveConfig(env_name="hopper_uni", env_options=options)  # type: ignore[arg-type]
    env = make_task(config).env
    plain: Any = newton_qd.create("hopper")
    material = plain.unwrapped.robot.material
    own = env.unwrapped.robot.material
    assert own.friction == 0.5 != material.friction
    assert own.static_penetration == material.static_penetration
    state = jax.jit(env.step)(env.reset(jax.random.key(0)), np.zeros(3, np.float32))
    assert state.metrics["reward_healthy"] == 0.25
    one, two = (env.reset(jax.random.key(seed)).obs for seed in (0, 1))
    assert (one == two).all()


@pytest.mark.parametrize(
    ("value", "name"),
    [
        ("maze", "maze"),
        (str(TESTS.parent / "examples" / "yard.urdf"), "yard"),
        ({"name": "mine", "urdf": MAZE.urdf, "links": ["torso"]}, "mine"),
    ],
)
def test_scenes_by_name_file_and_table(value: Any, name: str) -> None:
    from newton_qd.qd.scoring.task import _scene

    scene = _scene(dict(EvolveConfig(env_options={"s": value}).env_options)["s"])  # type: ignore[arg-type]
    assert scene.name == name and scene.urdf.endswith(".urdf")
    assert scene.links in (None, ("torso",))
    with pytest.raises(TypeError, match="scene: got 'moon'; allowed: trap, humanoid_"):
        _scene("moon")


MODULE = """
import dataclasses
import newton_qd.wrappers
from newton_qd.envs.ant import Ant
from newton_qd.qd import AlgorithmSpec, Options, register_algorithm
from newton_qd.qd.algorithms.me import ME

newton_qd.register(
    "{name}", Ant, descriptor=newton_qd.wrappers.FeetContactWrapper, base_name="ant"
)

@dataclasses.dataclass(frozen=True, kw_only=True)
class MyOptions(Options):
    \"\"\"Options of mine.

    Attributes:
        courage: How brave it is [-].
    \"\"\"

    courage: float = 0.5

register_algorithm(AlgorithmSpec(
    name="{name}-me", summary="mine", make=ME.make, options=MyOptions
))
"""


@pytest.fixture
def forgotten() -> Any:
    """Removes what a test registers."""
    from newton_qd import tasks
    from newton_qd.qd.algorithms import _REGISTERED

    names, path = set(tasks.ENVIRONMENTS), list(sys.path)
    yield
    for name in set(tasks.ENVIRONMENTS) - names:
        del tasks.ENVIRONMENTS[name]
    _REGISTERED.clear()
    sys.path[:] = path


@pytest.mark.usefixtures("forgotten")
def test_modules_register_environments_and_algorithms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_tasks.py").write_text(MODULE.format(name="mine"))
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "others.py").write_text(MODULE.format(name="other"))
    modules = ["--module", "my_tasks", "--module", "sub/others.py"]
    assert cli.main(["algorithms", *modules]) == cli.OK
    listed = capsys.readouterr().out
    assert "mine-me" in listed and "other-me" in listed
    assert "mine" in newton_qd.registered_envs()
    del sys.modules["my_tasks"]
    assert cli.main(["algorithms", "mine-me"]) == cli.OK
    assert "courage=0.5  How brave it is" in capsys.readouterr().out
    own = ["--algorithm", "mine-me", "--option", "courage=0.75"]
    out = tmp_path / "run"
    assert cli.main([*POINT, *own, "--out", str(out)], task_factory=point_task) == 0
    assert read_config(out / "config.json")[0].options == (("courage", 0.75),)


@pytest.mark.usefixtures("forgotten")
def test_modules_that_cannot_be_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken_tasks.py").write_text("import newton_qd\n1 / 0\n")
    (tmp_path / "poor_tasks.py").write_text("import no_such_package\n")
    (tmp_path / "random.py").write_text("")
    (tmp_path / "script.py").write_text("import sys\nsys.exit()\n")
    for name, text in (
        ("no_such_tasks", "got 'no_such_tasks', which cannot be found; allowed: a mod"),
        ("no.such.tasks", "got 'no.such.tasks', which cannot be found"),
        ("missing.py", "which cannot be found"),
        ("broken_tasks", "whose import fails with ZeroDivisionError: division by zero"),
        ("broken_tasks.py", "whose import fails with ZeroDivisionError"),
        ("poor_tasks", "ModuleNotFoundError: No module named 'no_such_package'"),
        ("random.py", "which has the name of Python's own module random"),
        ("script.py", "whose import ends the program with code None; allowed: a mod"),
    ):
        assert cli.main(["algorithms", "--module", name]) == cli.BAD_ARGUMENTS
        assert text in capsys.readouterr().err
        assert "broken_tasks" not in sys.modules
    assert cli.main(["evolve", "my_ant"]) == cli.BAD_ARGUMENTS
    assert "registers it, add --module NAME" in capsys.readouterr().err


def test_commands_without_modules_need_no_present_folder(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def deleted() -> str:
        raise FileNotFoundError(2, "No such file or directory")

    monkeypatch.setattr("os.getcwd", deleted)
    assert cli.main(["algorithms", "me"]) == cli.OK
    assert capsys.readouterr().out


@pytest.mark.usefixtures("forgotten")
def test_registered_algorithms_have_names_of_their_own() -> None:
    me = algorithm_named("me")
    with pytest.raises(ValueError, match=r"spec\.name: got 'me', which is taken"):
        register_algorithm(me)
    with pytest.raises(ValueError, match=r"spec\.name: got 'me', which is taken"):
        register_algorithm(me, replace=True)
    with pytest.raises(TypeError, match="spec: got 'me'; allowed: an AlgorithmSpec"):
        register_algorithm("me")  # type: ignore[arg-type]
    assert algorithms() == ALGORITHMS
    register_algorithm(dataclasses.replace(me, name="mine"))
    with pytest.raises(ValueError, match="'mine', which is taken; allowed: a new name"):
        register_algorithm(dataclasses.replace(me, name="mine"))
    newer = dataclasses.replace(me, name="mine")
    register_algorithm(newer, replace=True)
    assert algorithm_named("mine") is newer


def test_help_has_the_options_of_an_algorithm(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["evolve", "--help", "--algorithm", "pga-me"])
    assert ended.value.code == cli.OK
    printed = capsys.readouterr().out
    assert "--env-option NAME=VALUE" in printed and "--device" in printed
    assert "greedy_learning_rate=0.0003" in printed
    assert printed.rstrip().endswith("Give them as --option NAME=VALUE.")
    assert cli.main(["evolve", "--help", "--algorithm", "no"]) == cli.BAD_ARGUMENTS
    error = capsys.readouterr().err
    assert "'no', which does not exist" in error
    assert "those that register_algorithm adds (--module NAME)" in error


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["--version"])
    assert ended.value.code == cli.OK
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"newton_qd {newton_qd.__version__}"
    assert f"jax {jax.__version__}" in lines


def test_the_command_is_a_module_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["newton-qd", "algorithms", "me"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("newton_qd", run_name="__main__")
    assert ended.value.code == cli.OK and "me: " in capsys.readouterr().out


def test_devices_by_name(tmp_path: Path) -> None:
    config = SMALL.replace(iterations=0)
    for name, text in (
        ("gpu", r"device: got 'gpu'; allowed: one that JAX finds: .*\[cuda12\] or"),
        ("cpu:999", "device: got 'cpu:999'; allowed: one that JAX finds"),
        ("cpu:-1", "device: got 'cpu:-1'"),
        ("cpu:one", "device: got 'cpu:one'"),
        ("", "device: got ''; allowed: text"),
    ):
        if name == "gpu" and jax.default_backend() == "gpu":
            continue
        with pytest.raises(ConfigError, match=text):
            evolve(config, device=name, task_factory=point_task, out=tmp_path / "run")
    with pytest.raises(
        ConfigError, match=r"device, devices: got \('cpu', 1\); allowed"
    ):
        evolve(config, device="cpu", devices=1, task_factory=point_task)
    assert not list(tmp_path.iterdir())
    found = evolve(config, device="cpu", task_factory=point_task, progress=False)
    assert found.iteration == 0


def test_a_reader_that_leaves_early_is_no_failure() -> None:
    code = "import sys; from newton_qd.cli import main; sys.exit(main(sys.argv[1:]))"
    process = processes.start(
        [sys.executable, "-c", code, "algorithms"], seconds=100.0, cwd=TESTS
    )
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == ""
    assert process.wait(timeout=60) == cli.OK
