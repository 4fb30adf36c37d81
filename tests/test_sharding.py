"""Evaluation spread over devices: the same results, each device with its share."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from newton_qd.qd.sharding import device_mesh

ROOT = Path(__file__).resolve().parent.parent
COMMON = """
import json, sys
import jax, jax.numpy as jnp, numpy as np
from newton_qd.qd import EvolveConfig, make_policy, make_scoring_function, make_task
from newton_qd.qd.sharding import device_mesh, shard_scoring

def problem(name, count, episode_length=10):
    config = EvolveConfig(env_name=name, episode_length=episode_length, hidden=(8,))
    task = make_task(config)
    policy = make_policy(task.env, config.hidden)
    score = make_scoring_function(task, policy, episode_length)
    keys = jax.random.split(jax.random.key(1), count)
    return score, np.asarray(jax.jit(jax.vmap(policy.init))(keys))
"""


def start(code: str, **variables: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", COMMON + code],
        cwd=ROOT,
        env={**os.environ, "JAX_PLATFORMS": "cpu", **variables},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def answer(process: subprocess.Popen[str]) -> Any:
    output, errors = process.communicate(timeout=540)
    assert process.returncode == 0, errors
    return json.loads(output.splitlines()[-1])


FOUR_DEVICES = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}


def test_a_mesh_has_the_devices_that_exist() -> None:
    count = len(jax.devices())
    assert device_mesh().size == count and device_mesh(1).size == 1
    with pytest.raises(ValueError, match=f"count={count + 1}: allowed: 1 to {count}"):
        device_mesh(count + 1)


@pytest.mark.slow
def test_results_do_not_depend_on_the_number_of_devices() -> None:
    code = """
score, genotypes = problem("ant_uni", 22)
key = jax.random.key(2)
expected = jax.jit(score)(genotypes, key)
shapes = []

def watched(genotypes, key):
    shapes.append(genotypes.shape[0])
    return score(genotypes, key)

for count in (1, 2, 4):
    found = jax.jit(shard_scoring(watched, device_mesh(count)))(genotypes, key)
    assert len(found[0].sharding.device_set) == count
    for a, b in zip(expected[:2], found[:2]):
        np.testing.assert_array_equal(a, b)
print(json.dumps(shapes))
"""
    # 22 individuals on 4 devices are 24 with the copies that fill up.
    assert answer(start(code, **FOUR_DEVICES)) == [22, 11, 6]


@pytest.mark.slow
def test_no_device_steps_more_worlds_than_its_share() -> None:
    code = """
from newton_qd.physics import launch
score, genotypes = problem("ant_uni", 32, 5)
launched = []
original = launch.Launcher.launch

def recorded(self, name, worlds, *arguments, **options):
    launched.append((name, worlds))
    return original(self, name, worlds, *arguments, **options)

launch.Launcher.launch = recorded
mesh = device_mesh(4)
jax.block_until_ready(
    jax.jit(shard_scoring(score, mesh))(genotypes, jax.random.key(2))
)
step = max(set(name for name, _ in launched), key=[n for n, _ in launched].count)
print(json.dumps([worlds for name, worlds in launched if name == step]))
"""
    # Five steps on each of four devices.
    assert answer(start(code, **FOUR_DEVICES)) == [8] * 20


@pytest.mark.slow
def test_two_processes_agree_with_one() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    code = """
from jax.sharding import NamedSharding, PartitionSpec
address, index = "ADDRESS", INDEX
if index is not None:
    jax.distributed.initialize(address, num_processes=2, process_id=index)
score, genotypes = problem("ant_uni", 16, 5)
mesh = device_mesh()
data = np.asarray(jax.random.key_data(jax.random.key(2)))

def run(genotypes, data):
    return shard_scoring(score, mesh)(genotypes, jax.random.wrap_key_data(data))

everywhere = NamedSharding(mesh, PartitionSpec())
found = jax.jit(run)(*jax.device_put((genotypes, data), everywhere))
print(json.dumps([mesh.size, *(np.asarray(x).tolist() for x in found[:2])]))
"""
    code = code.replace("ADDRESS", address)
    runs = [start(code.replace("INDEX", text)) for text in ("0", "1", "None")]
    first, second, alone = (answer(process) for process in runs)
    assert (first[0], alone[0]) == (2, 1)
    assert first == second
    np.testing.assert_array_equal(first[1], alone[1])
    np.testing.assert_array_equal(first[2], alone[2])
