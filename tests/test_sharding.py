"""Evaluation spread over devices: the same results, each device with its share."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import jax
import numpy as np
import processes
import pytest
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from test_algorithms import CRITIC

import newton_qd
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.run.evolution import evolve
from newton_qd.qd.scoring.sharding import device_mesh, on_mesh

TESTS = Path(__file__).resolve().parent
COMMON = """
import json, sys
import jax, jax.numpy as jnp, numpy as np
from newton_qd.qd import EvolveConfig, make_policy, make_scoring_function, make_task
from newton_qd.qd.scoring.sharding import device_mesh, shard_scoring

def problem(name, count, episode_length=10):
    config = EvolveConfig(env_name=name, episode_length=episode_length, hidden=(8,))
    task = make_task(config)
    policy = make_policy(task.env, config.hidden)
    score = make_scoring_function(task, policy, episode_length)
    keys = jax.random.split(jax.random.key(1), count)
    return score, np.asarray(jax.jit(jax.vmap(policy.init))(keys))
"""


# Runs the code of each line of its input, and prints its answer or its error.
SERVE = """
import contextlib, traceback
for line in sys.stdin:
    names = dict(globals())
    try:
        with contextlib.redirect_stdout(sys.stderr):
            exec(json.loads(line), names)
        found = {"answer": names["answer"]}
    except Exception:
        found = {"error": traceback.format_exc()}
    print(json.dumps(found), flush=True)
"""
SECONDS = 540.0
FLAGS = os.environ.get("XLA_FLAGS", "")
FOUR_DEVICES = f"{FLAGS} --xla_force_host_platform_device_count=4"


def start(
    code: str, seconds: float = SECONDS, flags: str = FLAGS, **options: Any
) -> subprocess.Popen[str]:
    return processes.start(
        [sys.executable, "-W", "ignore", "-c", COMMON + code],
        seconds=seconds,
        cwd=TESTS,
        env={**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags},
        **options,
    )


class Devices:
    """A process with four devices, which several tests share: its start takes long."""

    def __init__(self, errors: IO[str]) -> None:
        streams = {"stdin": subprocess.PIPE, "stderr": errors}
        self._process = start(SERVE, 4 * SECONDS, FOUR_DEVICES, **streams)
        self._errors = Path(errors.name)

    def answer(self, code: str) -> Any:
        """What some code, which has names of its own, leaves in ``answer``."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(json.dumps(code) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        assert line, self._errors.read_text()
        found = json.loads(line)
        assert "error" not in found, found["error"]
        return found["answer"]

    def end(self) -> None:
        self._process.communicate()
        assert self._process.returncode == 0, self._errors.read_text()


@pytest.fixture(scope="module")
def devices(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Devices]:
    path = tmp_path_factory.mktemp("devices") / "errors"
    with path.open("w", encoding="utf-8") as errors:
        shared = Devices(errors)
        yield shared
        shared.end()


def two_processes(code: str) -> list[Any]:
    """Answers of two processes of one JAX."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    join = f"jax.distributed.initialize({address!r}, 2, %d)\n"
    end = "print(json.dumps(answer))\n"
    answers = []
    for process in [start(join % number + code + end) for number in (0, 1)]:
        output, errors = process.communicate(timeout=SECONDS)
        assert process.returncode == 0, errors
        answers.append(json.loads(output.splitlines()[-1]))
    return answers


def test_a_mesh_has_the_devices_that_exist() -> None:
    count = len(jax.devices())
    assert device_mesh().size == count and device_mesh(1).size == 1
    with pytest.raises(ValueError, match=f"count: got {count + 1}; .* 1 to {count}"):
        device_mesh(count + 1)


@pytest.mark.optimized
@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_devices(devices: Devices) -> None:
    code = """
def shapes_of(name):
    score, genotypes = problem(name, 22)
    key = jax.random.key(2)
    expected = jax.jit(score)(genotypes, key)
    shapes = []

    def watched(genotypes, key):
        shapes.append(genotypes.shape[0])
        return score(genotypes, key)

    for count in (1, 2, 4):
        found = jax.jit(shard_scoring(watched, device_mesh(count)))(genotypes, key)
        assert len(found[0].sharding.device_set) == count, name
        for a, b in zip(expected[:2], found[:2]):
            np.testing.assert_array_equal(a, b, err_msg=name)
    return shapes

answer = [shapes_of(name) for name in ("ant_uni", "pointmaze")]
"""
    # 22 individuals on 4 devices are 24 with the copies that fill up.
    assert devices.answer(code) == [[22, 11, 6]] * 2


@pytest.mark.slow
def test_what_makes_genotypes_is_not_split(devices: Devices) -> None:
    """Its rounding errors would depend on the number of devices."""
    code = """
import re
mesh = device_mesh(3)
score = shard_scoring(lambda x, key: (x.sum(axis=1), x, {}), mesh)
everywhere = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec())
x = jax.device_put(np.ones((12, 8), np.float32), everywhere)
made = jax.jit(lambda x: score(x @ x.T, jax.random.key(0))[0]).lower(x).compile()
answer = re.findall(r"f32\\[(\\d+),12\\]\\S* dot\\(", made.as_text())
"""
    assert devices.answer(code) == ["12"]


@pytest.mark.slow
def test_no_device_steps_more_worlds_than_its_share(devices: Devices) -> None:
    # of a robot that no other test here steps, because a plan counts from its start
    code = """
from newton_qd.physics.native import all_plans
before = all_plans()
score, genotypes = problem("walker2d_uni", 32, 5)
mesh = device_mesh(4)
jax.block_until_ready(
    jax.jit(shard_scoring(score, mesh))(genotypes, jax.random.key(2))
)
plans = [plan for plan in all_plans() if plan not in before]
step = max(plans, key=lambda plan: plan.launches)
answer = [step.launches, step.most_worlds, step.worlds]
"""
    # Five steps on each of four devices.
    assert devices.answer(code) == [20, 8, 160]


def test_devices_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    count = len(jax.devices())
    with pytest.raises(
        ConfigError, match=rf"devices: got 99; allowed: .* 1 to {count}"
    ):
        evolve(EvolveConfig(), out=tmp_path / "run", devices=99)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_xla_splits_a_batch_on_automatic_axes(devices: Devices) -> None:
    """Without explicit axes, a call that XLA cannot split runs on all worlds."""
    code = """
import newton_qd
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from newton_qd.physics.native import all_plans
env = newton_qd.create("hopper_uni", auto_reset=False)
split = NamedSharding(Mesh(np.array(jax.devices()), ("x",)), PartitionSpec("x"))
states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 16))
actions = jax.random.uniform(jax.random.key(1), (16, 3))

@jax.jit
def both(states, actions):
    step = jax.vmap(env.step)
    slope = jax.grad(lambda a: step(states, a).reward.sum())(actions)
    return step(states, actions).obs, slope

@jax.jit
def rolled(states, actions):
    plan = jnp.stack([actions, -actions], axis=1)
    return jax.vmap(env.rollout)(states, plan).reward

def counted(function, *given):
    # the worlds of all plans: each of four devices must not run all of them
    before = sum(plan.worlds for plan in all_plans())
    found = jax.block_until_ready(function(*given))
    return found, sum(plan.worlds for plan in all_plans()) - before

answer = []
for function in (both, rolled):
    alone = counted(function, states, actions)
    shared = counted(function, *jax.device_put((states, actions), split))
    pairs = zip(*map(jax.tree.leaves, (alone[0], shared[0])))
    answer += [all(np.array_equal(a, b) for a, b in pairs), alone[1] == shared[1] > 0]
"""
    assert devices.answer(code) == [True] * 4


EVOLVE = """
import warnings
warnings.simplefilter("ignore")
import newton_qd.qd

def evolved(name, algorithm="me", options=(), **arguments):
    config = EvolveConfig(
        env_name=name, algorithm=algorithm, options=options, iterations=3,
        batch_size=10, episode_length=10, hidden=(8,), centroids=32, reevaluations=2,
    )
    found = newton_qd.qd.evolve(config, progress=False, **arguments)
    archive, again = found.archive, found.reevaluated
    names = ("genotypes", "fitnesses", "descriptors")
    return [str(again), *(np.asarray(getattr(archive, x)).tolist() for x in names)]
"""


@pytest.mark.slow
def test_an_archive_does_not_depend_on_the_number_of_devices(devices: Devices) -> None:
    # compiling takes the time, and what an algorithm adds is the same on every mesh
    tasks: list[tuple[tuple[Any, ...], tuple[int, ...]]] = [
        (("ant_uni", "me", {}), (1, 3, 4)),
        (("pointmaze", "pga-me", CRITIC), (3,)),
        (("pointmaze", "me-es", {"num_optimizer_steps": 2}), (3,)),
    ]
    code = f"""
answer = []
for task, counts in {tasks!r}:
    alone = evolved(*task)
    answer += [evolved(*task, devices=count) == alone for count in counts]
"""
    assert devices.answer(EVOLVE + code) == [True] * 5


@pytest.mark.parametrize("generator", ["threefry2x32", "rbg"])
def test_keys_of_several_processes_keep_their_generator(
    monkeypatch: pytest.MonkeyPatch, generator: str
) -> None:
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    key = jax.random.key(3, impl=generator)
    draw = on_mesh(lambda key: jax.random.bits(key, (2,)), device_mesh(1))
    np.testing.assert_array_equal(draw(key), jax.random.bits(key, (2,)))


@pytest.mark.slow
def test_two_processes_agree_with_one(devices: Devices) -> None:
    """In the scores of a batch, and in the archive of a run."""
    code = """
import tempfile
from jax.sharding import NamedSharding, PartitionSpec
score, genotypes = problem("ant_uni", 16, 5)
mesh = device_mesh(count)
data = np.asarray(jax.random.key_data(jax.random.key(2)))

def run(genotypes, data):
    return shard_scoring(score, mesh)(genotypes, jax.random.wrap_key_data(data))

everywhere = NamedSharding(mesh, PartitionSpec())
found = jax.jit(run)(*jax.device_put((genotypes, data), everywhere))
scored = [mesh.size, *(np.asarray(x).tolist() for x in found[:2])]

try:
    with tempfile.TemporaryDirectory() as out:
        found = evolved("pointmaze", devices=count, resume=True, out=out)
    refused = ""
except newton_qd.qd.ConfigError as error:
    refused, found = str(error), evolved("pointmaze", devices=count)
answer = [scored, found, refused]
"""
    first, second = two_processes("count = jax.device_count()\n" + EVOLVE + code)
    alone = devices.answer("count = 1\n" + EVOLVE + code)
    assert (first[0][0], alone[0][0]) == (2, 1)
    assert first[0] == second[0]
    np.testing.assert_array_equal(first[0][1], alone[0][1])
    np.testing.assert_array_equal(first[0][2], alone[0][2])
    assert first[1] == second[1] == alone[1]
    assert (
        first[2].startswith("resume: got True, with 2 processes; allowed: ")
        and alone[2] == ""
    )


def check_devices(**variables: str) -> None:
    """Runs the benchmark, which compares one device with all of them."""
    arguments = ["--batch-size", "30", "--episode-length", "10"]
    done = subprocess.run(
        [sys.executable, "benchmarks/devices.py", *arguments],
        cwd=TESTS.parent,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        check=False,
        timeout=540,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_virtual_devices_share_the_worlds() -> None:
    check_devices(JAX_PLATFORMS="cpu", XLA_FLAGS=FOUR_DEVICES)


@pytest.mark.gpu
def test_gpus_share_the_worlds() -> None:
    if len(jax.devices("gpu")) < 2:
        pytest.skip("needs two GPUs")
    check_devices()


@pytest.mark.gpu
def test_gpus_split_a_batch_on_automatic_axes() -> None:
    """A call that XLA cannot split would gather the worlds of all GPUs on each."""
    devices = jax.devices("gpu")[:2]
    if len(devices) < 2:
        pytest.skip("needs two GPUs")
    env = newton_qd.create("hopper_uni", auto_reset=False)
    states = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), 16))
    actions = jax.random.uniform(jax.random.key(1), (16, 3))
    rows = NamedSharding(Mesh(np.array(devices), ("x",)), PartitionSpec("x"))
    split = jax.device_put((states, actions), rows)

    def slope(states: newton_qd.State, actions: jax.Array) -> jax.Array:
        step = jax.vmap(env.step)
        return jax.grad(lambda a: step(states, a).reward.sum())(actions)

    step = jax.jit(jax.vmap(env.step))
    for function in (step, jax.jit(slope)):
        text = function.lower(*split).compile().as_text()
        assert text is not None and "all-gather" not in text
    pairs = zip(
        *map(jax.tree.leaves, (step(states, actions), step(*split))), strict=True
    )
    assert all(np.array_equal(one, two) for one, two in pairs)


@pytest.mark.slow
@pytest.mark.skipif(
    jax.__version_info__ < (0, 10), reason="before, JAX cannot split random numbers so"
)
def test_a_mesh_with_explicit_axes_splits_steps_and_gradients(
    devices: Devices,
) -> None:
    """Axes are explicit by default; each device steps its share of the worlds."""
    code = """
import contextlib
import newton_qd
from newton_qd.gradients import Episode
from jax.sharding import NamedSharding, PartitionSpec
from newton_qd.physics.native import all_plans

# every plan: the kernels of a reset and of the way back do not run in between
def launched():
    return np.array([[plan.launches, plan.worlds] for plan in all_plans()]).sum(axis=0)

env = newton_qd.create("ant_uni")
keys = jax.random.split(jax.random.key(0), 8)
actions = jnp.full((8, env.action_size), 0.1)
reset, step = (jax.jit(jax.vmap(f)) for f in (env.reset, env.step))

@jax.jit
def slope(state, action):
    return jax.grad(lambda a: jax.vmap(env.step)(state, a).reward.sum())(action)

# rollouts, and episodes of plans and of policies, with their gradients
plans = jax.random.uniform(keys[1], (8, 3, env.action_size), minval=-1.0)
weights = jax.random.normal(keys[2], (8, env.observation_size, env.action_size)) / 9
extractor = newton_qd.tables.descriptor_extractor["ant_uni"]

@jax.jit
def whole(state, plans, weights, key):
    planned, closed = (
        Episode(env, policy, extractor, episode_length=3)
        for policy in (None, lambda w, seen: jnp.tanh(seen @ w))
    )
    return (
        jax.vmap(env.rollout)(state, plans),
        planned.gradient(plans, key),
        closed.gradient(weights, key),
    )

start, one = reset(keys), jax.jit(env.reset)(keys[0])
found = (start, step(start, actions), slope(start, actions))
expected = jax.tree.leaves(jax.block_until_ready(found))
long = jax.tree.leaves(whole(start, plans, weights, keys[3]))
for count, entered in ((2, False), (4, True)):
    mesh = jax.make_mesh((count,), ("b",), devices=jax.devices()[:count])
    assert mesh.axis_types == (jax.sharding.AxisType.Explicit,)
    axis = NamedSharding(mesh, PartitionSpec("b"))
    own_keys, own_actions = jax.device_put((keys, actions), axis)
    with jax.set_mesh(mesh) if entered else contextlib.nullcontext():
        start = reset(own_keys)
        jax.block_until_ready(start)
        before = launched()
        after = jax.block_until_ready(step(start, own_actions))
        each = launched() - before
        assert each.tolist() == [count, 8], each
        found = jax.tree.leaves((start, after, slope(start, own_actions)))
        for axes, state, action in (
            ((0, None), start, actions[0]),
            ((None, 0), one, own_actions),
        ):
            shared = jax.jit(jax.vmap(env.step, axes))(state, action)
            jax.block_until_ready((shared, found))
        given = *jax.device_put((plans, weights), axis), keys[3]
        given = jax.tree.leaves(whole(start, *given))
        for a, b in zip(long, given, strict=True):
            assert b.sharding.spec[0] == "b", b.sharding
            np.testing.assert_array_equal(a, b)
    for a, b in zip(expected, found, strict=True):
        assert b.sharding.spec[0] == "b", b.sharding
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)
answer = True
"""
    assert devices.answer(code)


@pytest.mark.slow
@pytest.mark.parametrize("axes", ["Auto", "Explicit"])
def test_an_episode_with_its_reset_runs_on_a_mesh(devices: Devices, axes: str) -> None:
    """The loop needs the same types before and after a step, also of parameters."""
    if axes == "Explicit" and jax.__version_info__ < (0, 10):
        pytest.skip("before, JAX cannot split random numbers so")
    code = """
import newton_qd
from jax.sharding import AxisType, NamedSharding, PartitionSpec
from newton_qd.wrappers import RandomParamsWrapper
env = newton_qd.create("hopper_uni", episode_length=2, eval_metrics=True)
env = RandomParamsWrapper(env, friction=(0.5, 1.0))
keys = jax.random.split(jax.random.key(0), 8)

def episode(key):
    def advance(state, _):
        state = env.step(state, jnp.full(env.action_size, 0.1))
        return state, state.reward
    return jax.lax.scan(advance, env.reset(key), None, length=3)[1]

run, split = jax.vmap(episode), PartitionSpec("x")
mesh = jax.make_mesh((2,), ("x",), (AxisType.AXES,), devices=jax.devices()[:2])
expected = jax.jit(run)(keys)
if AxisType.AXES == AxisType.Auto:
    each = jax.shard_map(run, mesh=mesh, in_specs=split, out_specs=split)
    found = jax.jit(each)(keys)
else:
    with jax.set_mesh(mesh):
        found = jax.jit(run)(jax.device_put(keys, NamedSharding(mesh, split)))
answer = bool(np.array_equal(expected, found))
"""
    assert devices.answer(code.replace("AXES", axes)) is True
