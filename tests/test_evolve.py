"""The evolution loop on a tiny task: results, resumption, damage, interrupts.

The task needs no physics, so that a run takes a fraction of a second;
``test_cli.py`` runs the real one.
"""

from __future__ import annotations

import dataclasses
import io
import json
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import processes
import pytest

from newton_qd import files
from newton_qd.errors import MissingExtra, UnknownEnvironment
from newton_qd.extractors import get_feet_contact_proportion
from newton_qd.qd.config import ConfigError, EvolveConfig, read_config
from newton_qd.qd.run import plot, search
from newton_qd.qd.run.archive import Archive, load_archive
from newton_qd.qd.run.checkpoint import CheckpointError
from newton_qd.qd.run.evolution import EvolveResult, evolve
from newton_qd.qd.run.folder import RunFolder
from newton_qd.qd.run.interrupt import INTERRUPTED, graceful_stop
from newton_qd.qd.run.progress import Progress
from newton_qd.qd.run.search import Search, SearchError
from newton_qd.qd.scoring.rollout import make_policy, make_scoring_function
from newton_qd.qd.scoring.task import Task, make_task

evolve_module = sys.modules[evolve.__module__]

TESTS = Path(__file__).resolve().parent
FILES = ("archive.npz", "archive.png", "checkpoint.bin", "config.json", "metrics.csv")
SMALL = EvolveConfig(
    env_name="point",
    iterations=12,
    batch_size=16,
    episode_length=9,
    hidden=(4,),
    grid=(4, 4),
    reevaluations=0,
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PointState:
    pipeline_state: jax.Array
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    info: dict[str, jax.Array]


class PointEnv:
    """A point that is pushed about; ``done`` outside a circle, faulty far right."""

    observation_size = 3
    action_size = 2
    fault_beyond = 1.5

    def reset(self, rng: jax.Array) -> PointState:
        position = jax.random.uniform(rng, (2,), jnp.float32, -0.1, 0.1)
        return self._state(position, jnp.zeros((), jnp.float32))

    def step(self, state: PointState, action: jax.Array) -> PointState:
        position = state.pipeline_state + jnp.float32(0.3) * action
        reward = 1.0 - jnp.sum(jnp.square(position - jnp.float32(0.5)))
        return self._state(position, reward)

    def _state(self, position: jax.Array, reward: jax.Array) -> PointState:
        bias = jnp.ones((1,), jnp.float32)
        return PointState(
            pipeline_state=position,
            obs=jnp.concatenate([position, bias]),
            reward=reward,
            done=(jnp.sum(jnp.square(position)) > 4.0).astype(jnp.float32),
            info={
                "state_descriptor": (position > 0.2).astype(jnp.float32),
                "fault": (position[0] > self.fault_beyond).astype(jnp.int32),
            },
        )


def point_task(config: EvolveConfig, env: Any = None) -> Task:
    del config
    return Task(
        env=PointEnv() if env is None else env,
        descriptor_extractor=get_feet_contact_proportion,
        limits=(np.zeros(2, np.float32), np.ones(2, np.float32)),
        labels=("left", "right"),
        reward_offset=5.0,
    )


def run(config: EvolveConfig = SMALL, **options: Any) -> EvolveResult:
    options = {"progress": False, "checkpoint_seconds": 0.0, **options}
    return evolve(config, task_factory=point_task, **options)


@pytest.fixture(scope="module", autouse=True)
def compile_once() -> Iterator[None]:
    """Share compiled functions between runs with the same settings."""
    made: dict[tuple[EvolveConfig, bool], Search] = {}

    def search(config: EvolveConfig, task: Task, mesh: Any) -> Search:
        key = (config, bool(jax.config.read("jax_enable_x64")))
        if type(task.env) is not PointEnv or mesh is not None:
            return Search(config, task, mesh)
        return made.setdefault(key, made.get(key) or Search(config, task))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evolve_module, "Search", search)
        yield


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results folder of a run that nothing disturbed."""
    out = tmp_path_factory.mktemp("reference") / "run"
    assert not run(out=out).interrupted
    return out


def assert_same_results(out: Path, expected: Path) -> None:
    for name in FILES:
        assert (out / name).read_bytes() == (expected / name).read_bytes(), name
    names = sorted(entry.name for entry in expected.iterdir())
    assert set(FILES) <= set(names)
    assert sorted(entry.name for entry in out.iterdir()) == names


# --- results ---------------------------------------------------------------


def test_run_improves_and_reports(reference: Path) -> None:
    result = run()
    metrics = result.metrics
    assert result.iteration == SMALL.iterations and result.out is None
    assert np.array_equal(metrics["iteration"], np.arange(13))
    assert np.array_equal(metrics["evaluations"], 16 * np.arange(1, 14))
    assert np.array_equal(metrics["env_steps"], 9 * metrics["evaluations"])
    for name in ("qd_score", "coverage", "max_fitness"):
        assert np.all(np.diff(metrics[name]) >= 0), f"{name} fell"
        assert metrics[name][-1] > metrics[name][0], f"{name} did not improve"
    archive, kept = result.archive, load_archive(reference)
    for name in ("genotypes", "fitnesses", "descriptors", "centroids"):
        assert np.array_equal(getattr(archive, name), getattr(kept, name)), name
    filled = archive.filled
    assert metrics["coverage"][-1] == pytest.approx(100 * filled.mean())
    assert metrics["max_fitness"][-1] == archive.fitnesses.max()
    score = np.sum(archive.fitnesses[filled] + 5.0 * 9)
    assert metrics["qd_score"][-1] == pytest.approx(score, rel=1e-5)


def test_archive_rows_are_what_the_policies_do(reference: Path) -> None:
    archive = load_archive(reference)
    task = point_task(SMALL)
    policy = make_policy(task.env, SMALL.hidden)
    assert archive.genotypes.shape == (16, policy.size)
    score = jax.jit(make_scoring_function(task, policy, SMALL.episode_length))
    key = jax.random.split(jax.random.key(SMALL.seed), 4)[1]
    filled = archive.filled
    fitnesses, descriptors, _ = score(archive.genotypes[filled], key)
    np.testing.assert_allclose(fitnesses, archive.fitnesses[filled], rtol=1e-5)
    np.testing.assert_array_equal(descriptors, archive.descriptors[filled])
    distance = np.abs(descriptors[:, None] - archive.centroids[None]).max(-1)
    assert np.all(distance.min(1) <= 0.125 + 1e-6)
    assert np.all(distance[np.arange(filled.sum()), np.flatnonzero(filled)] < 0.126)


def test_metrics_file(reference: Path) -> None:
    lines = (reference / "metrics.csv").read_text().splitlines()
    head = "iteration,evaluations,env_steps,rejected,qd_score,coverage,max_fitness"
    assert lines[0] == head
    assert [int(line.split(",")[0]) for line in lines[1:]] == list(range(13))


@pytest.mark.slow
def test_corrected_metrics_are_those_of_the_elites_put_anew(tmp_path: Path) -> None:
    config = SMALL.replace(iterations=2, reevaluations=5)
    result = run(config, out=tmp_path / "run")
    again = result.reevaluated
    assert again is not None
    written = json.loads((tmp_path / "run" / "corrected.json").read_text())
    assert written == dataclasses.asdict(again)
    task = point_task(config)
    policy = make_policy(task.env, config.hidden)
    score = jax.jit(make_scoring_function(task, policy, config.episode_length))
    reset = jax.random.fold_in(jax.random.split(jax.random.key(config.seed), 4)[1], 1)
    genotypes = result.archive.genotypes[result.archive.filled]
    scores = [score(genotypes, key)[:2] for key in jax.random.split(reset, 5)]
    fitness = np.median([np.asarray(f) for f, _ in scores], axis=0)
    found = np.median([np.asarray(d) for _, d in scores], axis=0)
    best: dict[int, float] = {}
    for value, descriptor in zip(fitness, found, strict=True):
        distance = np.square(result.archive.centroids - descriptor).sum(-1)
        cell = int(distance.argmin())
        best[cell] = max(value, best.get(cell, -np.inf))
    assert again.coverage == 100 * len(best) / 16
    assert again.max_fitness == pytest.approx(max(best.values()))
    assert again.qd_score == pytest.approx(sum(best.values()) + 45 * len(best))
    assert run(SMALL.replace(iterations=1)).reevaluated is None


def test_seed_decides() -> None:
    first, again, other = run(), run(), run(SMALL.replace(seed=1))
    assert np.array_equal(first.archive.genotypes, again.archive.genotypes)
    assert not np.array_equal(first.archive.genotypes, other.archive.genotypes)


def test_voronoi_cells() -> None:
    config = SMALL.replace(grid=None, centroids=10, iterations=2)
    first, again = run(config), run(config)
    assert first.archive.centroids.shape == (10, 2)
    assert np.array_equal(first.archive.centroids, again.archive.centroids)
    assert np.array_equal(first.archive.genotypes, again.archive.genotypes)


def test_default_grid_is_filled_in() -> None:
    config = SMALL.replace(grid=None)
    assert [config.resolve(n).grid for n in (2, 4)] == [(32, 32), (5, 5, 5, 5)]
    assert config.replace(centroids=9).resolve(2).grid is None
    with pytest.raises(ConfigError, match=r"descriptor of 5 components.*centroids"):
        config.resolve(5)


def test_x64_changes_no_type(x64: None) -> None:
    result = run(SMALL.replace(iterations=2))
    assert result.archive.genotypes.dtype == np.float32
    assert result.metrics["coverage"][-1] > 0


# --- evaluation ------------------------------------------------------------


def brute_force(env: PointEnv, act_and_step: Any, genotype: Any, key: Any) -> tuple:
    state = env.reset(key)
    fitness, descriptors, faulty = 0.0, [], False
    for _ in range(SMALL.episode_length):
        descriptors.append(np.asarray(state.info["state_descriptor"]))
        state = act_and_step(state, genotype)
        fitness += float(state.reward)
        faulty |= bool(state.info["fault"])
        if state.done:
            break
    return (-np.inf if faulty else fitness), np.mean(descriptors, axis=0)


def test_scoring_agrees_with_a_plain_loop() -> None:
    task = point_task(SMALL)
    policy = make_policy(task.env, SMALL.hidden)
    genotypes = 3 * jax.vmap(policy.init)(jax.random.split(jax.random.key(3), 24))
    key = jax.random.key(4)
    score = jax.jit(make_scoring_function(task, policy, SMALL.episode_length))
    fitnesses, descriptors, _ = score(genotypes, key)

    @jax.jit
    def step(state: Any, genotype: Any) -> Any:
        action = policy.apply(policy.unravel(genotype), state.obs)
        return task.env.step(state, action)

    rows = [brute_force(task.env, step, genotype, key) for genotype in genotypes]
    expected = np.array([row[0] for row in rows])
    assert np.isinf(expected).any() and np.isfinite(expected).sum() > 5
    np.testing.assert_allclose(fitnesses, expected, rtol=1e-4)
    valid = np.isfinite(expected)
    np.testing.assert_allclose(
        descriptors[valid], np.array([row[1] for row in rows])[valid], rtol=1e-6
    )


def test_a_run_in_which_everything_is_faulty_ends() -> None:
    class Faulty(PointEnv):
        fault_beyond = -100.0

    with pytest.raises(SearchError, match="initial population"):
        evolve(
            SMALL,
            progress=False,
            task_factory=lambda config: point_task(config, Faulty()),
        )


def test_descriptors_out_of_bounds_go_to_the_nearest_cell() -> None:
    class Narrow(PointEnv):
        pass

    limits = np.full(2, 0.4, np.float32), np.full(2, 0.6, np.float32)
    task = dataclasses.replace(point_task(SMALL, Narrow()), limits=limits)
    config = SMALL.replace(iterations=1)
    archive = evolve(config, progress=False, task_factory=lambda _: task).archive
    filled = archive.filled
    found = archive.descriptors[filled]
    assert np.any((found < 0.4) | (found > 0.6))
    distance = np.square(found[:, None] - archive.centroids).sum(-1)
    np.testing.assert_array_equal(distance.argmin(1), np.flatnonzero(filled))


def test_genotypes_of_another_policy_are_refused() -> None:
    task = point_task(SMALL)
    policy = make_policy(task.env, SMALL.hidden)
    score = make_scoring_function(task, policy, SMALL.episode_length)
    for shape in ((5, policy.size + 1), (policy.size,)):
        with pytest.raises(
            ValueError, match=rf"genotypes: shape .* allowed: \(N, {policy.size}\)"
        ):
            jax.eval_shape(score, jnp.zeros(shape), jax.random.key(0))


def test_equal_individuals_of_a_cell_do_not_compete() -> None:
    descriptors = jnp.array([[0.1, 0.1], [0.9, 0.9], [0.1, 0.2], [0.2, 0.1]])
    fitnesses = jnp.array([1.0, 1.0, 1.0, 2.0])
    centroids = jnp.array([[0.2, 0.2], [0.8, 0.8]])
    kept = search._break_ties(fitnesses, descriptors, centroids)
    np.testing.assert_array_equal(kept, [1.0, 1.0, -np.inf, 2.0])


# --- resumption ------------------------------------------------------------


def interrupt_after(
    monkeypatch: pytest.MonkeyPatch, generation: int, number: int = signal.SIGINT
) -> None:
    advance = Search.advance

    def advance_and_signal(self: Search, state: Any) -> Any:
        state = advance(self, state)
        if state.iteration == generation:
            os.kill(os.getpid(), number)
        return state

    monkeypatch.setattr(Search, "advance", advance_and_signal)


@pytest.mark.optimized
@pytest.mark.parametrize("generation", [0, 1, 7, 12])
@pytest.mark.usefixtures("sigint")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_saves_and_resumes_bit_by_bit(
    reference: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    generation: int,
    number: int,
) -> None:
    out = tmp_path / "run"
    handler = signal.getsignal(number)
    with monkeypatch.context() as patch:
        interrupt_after(patch, generation, number)
        # No checkpoint in between: the state is saved because of the signal.
        result = run(out=out, checkpoint_seconds=1e9)
    assert signal.getsignal(number) is handler
    assert result.iteration == generation
    assert result.interrupted == (generation < SMALL.iterations)
    assert len((out / "metrics.csv").read_text().splitlines()) == generation + 2
    assert np.array_equal(load_archive(out).fitnesses, result.archive.fitnesses)
    assert not run(out=out, resume=True).interrupted
    assert_same_results(out, reference)


class Killed(BaseException):
    """Stands for SIGKILL at one moment."""


def test_a_kill_at_any_file_operation_can_be_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Before, in the middle of and after the writing of each file.
    monkeypatch.setattr(evolve_module, "archive_png", lambda *arguments: b"picture")
    config = SMALL.replace(iterations=2)
    expected = tmp_path / "expected"
    run(config, out=expected)
    moments = 3 * len(writes_of(config, tmp_path / "count", monkeypatch))
    assert moments > 20
    for moment in range(moments):
        out = tmp_path / f"run{moment}"
        with monkeypatch.context() as patch, pytest.raises(Killed):
            kill_at(patch, moment)
            run(config, out=out)
        # The command is the same whether or not the run had begun.
        run(config, out=out, resume=True)
        assert_same_results(out, expected)


def writes_of(
    config: EvolveConfig, out: Path, monkeypatch: pytest.MonkeyPatch
) -> list[str]:
    written: list[str] = []
    replace = os.replace
    with monkeypatch.context() as patch:
        patch.setattr(
            files.os,
            "replace",
            lambda a, b: (written.append(str(b)), replace(a, b)),
        )
        run(config, out=out)
    return written


def kill_at(patch: pytest.MonkeyPatch, moment: int) -> None:
    """Ends the run in the write number ``moment // 3``."""
    replace, calls = os.replace, iter(range(10**6))

    def replace_or_die(source: Path, target: Path) -> None:
        call = next(calls)
        if call == moment // 3 and moment % 3 == 0:  # half written
            content = Path(source).read_bytes()
            Path(source).write_bytes(content[: len(content) // 2])
            raise Killed
        if call == moment // 3 and moment % 3 == 1:  # whole, not yet in place
            raise Killed
        replace(source, target)
        if call == moment // 3:
            raise Killed

    patch.setattr(files.os, "replace", replace_or_die)


PROGRAM = (
    f"import sys; sys.path[:0] = [{str(TESTS)!r}]\n"
    "from test_evolve import point_task\n"
    "from newton_qd.cli import main\n"
    "sys.exit(main(sys.argv[1:], task_factory=point_task))"
)
LONG = ["point", "--iterations", "150", "--batch-size", "16", "--episode-length"]
LONG += ["9", "--hidden", "4", "--grid", "4x4", "--checkpoint-seconds", "0"]


def start(*arguments: str) -> subprocess.Popen[str]:
    return processes.start([sys.executable, "-c", PROGRAM, "evolve", *arguments])


def wait_for_generation(out: Path, generation: int, process: Any) -> None:
    deadline = time.monotonic() + 120
    path = out / "metrics.csv"
    while not path.exists() or len(path.read_text().splitlines()) < generation + 2:
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.005)


@pytest.mark.slow
def test_sigkill_at_random_moments(tmp_path: Path) -> None:
    expected, out = tmp_path / "expected", tmp_path / "run"
    process = start(*LONG, "--out", str(expected))
    begin = time.monotonic()
    wait_for_generation(expected, 0, process)
    compiled = time.monotonic() - begin
    _, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    whole = time.monotonic() - begin
    moments = random.Random(0)
    for attempt in range(6):
        process = start(*LONG, "--out", str(out), "--resume")
        # The first kills fall into start and compilation, the others into the loop.
        low = 0.0 if attempt < 2 else 0.9 * compiled
        high = compiled if attempt < 2 else 0.8 * compiled + 0.4 * whole
        time.sleep(moments.uniform(low, max(low, high)))
        process.kill()
        process.communicate()
    process = start(*LONG, "--out", str(out), "--resume")
    output, errors = process.communicate(timeout=240)
    assert process.returncode == 0, errors
    assert "150 generations" in output
    assert_same_results(out, expected)


@pytest.mark.slow
@pytest.mark.usefixtures("sigint")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_of_a_process(tmp_path: Path, number: int) -> None:
    out = tmp_path / "with space"
    process = start(*LONG, "--out", str(out))
    wait_for_generation(out, 3, process)
    process.send_signal(number)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == INTERRUPTED
    assert "Traceback" not in errors and "stopping" in errors
    assert f"newton-qd evolve --resume --out '{out}'" in output
    process = start("--resume", "--out", str(out), "--checkpoint-seconds", "0")
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    rows = (out / "metrics.csv").read_text().splitlines()[1:]
    assert [int(row.split(",")[0]) for row in rows] == list(range(151))


@pytest.mark.usefixtures("sigint")
def test_a_second_signal_quits_at_once_even_from_compiled_code() -> None:
    code = (
        "import hashlib\n"
        "from newton_qd.qd.run.interrupt import graceful_stop\n"
        "with graceful_stop() as stop:\n"
        "    print('ready', flush=True)\n"
        "    hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)\n"
    )
    process = processes.start([sys.executable, "-c", code], cwd=TESTS)
    assert process.stdout is not None and process.stderr is not None
    assert process.stdout.readline() == "ready\n"
    process.send_signal(signal.SIGINT)
    assert process.stderr.readline() == "\n"
    assert "stopping" in process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=30)
    assert process.returncode == INTERRUPTED


def test_other_threads_and_ignored_signals() -> None:
    seen: list[Any] = []

    def use() -> None:
        with graceful_stop() as stop:
            seen.append(stop.requested)

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert seen == [False]
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with graceful_stop():
            assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)


def test_resuming_a_finished_run_changes_nothing(
    reference: Path, tmp_path: Path
) -> None:
    out = copy(reference, tmp_path)
    (out / "archive.png").unlink()
    result = run(out=out, resume=True)
    assert result.iteration == SMALL.iterations and not result.interrupted
    assert_same_results(out, reference)


# --- bad input -------------------------------------------------------------


def copy(folder: Path, tmp_path: Path) -> Path:
    out = tmp_path / "copy"
    out.mkdir()
    for entry in folder.iterdir():
        (out / entry.name).write_bytes(entry.read_bytes())
    return out


def snapshot(folder: Path) -> dict[str, bytes]:
    return {entry.name: entry.read_bytes() for entry in folder.iterdir()}


def test_a_used_folder_is_refused(reference: Path, tmp_path: Path) -> None:
    before = snapshot(reference)
    with pytest.raises(ConfigError, match=r"not empty.*--resume"):
        run(out=reference)
    assert snapshot(reference) == before
    foreign = tmp_path / "foreign"
    foreign.mkdir()
    (foreign / "thesis.tex").write_text("text")
    for resume in (False, True):
        with pytest.raises(ConfigError, match="foreign"):
            run(out=foreign, resume=resume)
    assert snapshot(foreign) == {"thesis.tex": b"text"}
    with pytest.raises(ConfigError, match="is a file"):
        run(out=foreign / "thesis.tex")
    with pytest.raises(ConfigError, match="cannot create"):
        run(out=foreign / "thesis.tex" / "run")


CHANGES = {
    "seed": 1,
    "iterations": 13,
    "batch_size": 17,
    "episode_length": 10,
    "hidden": (5,),
    "grid": (4, 5),
    "iso_sigma": 0.1,
    "line_sigma": 0.1,
    "algorithm": "cma-me",
    "reevaluations": 2,
}


@pytest.mark.parametrize("name", CHANGES)
def test_resuming_with_a_changed_setting_names_it(reference: Path, name: str) -> None:
    before = snapshot(reference)
    with pytest.raises(ConfigError, match=f"^{name}: the run in"):
        run(SMALL.replace(**{name: CHANGES[name]}), out=reference, resume=True)
    assert snapshot(reference) == before


def test_every_setting_has_a_changed_value() -> None:
    names = {field.name for field in dataclasses.fields(EvolveConfig)}
    assert names - set(CHANGES) == {"env_name", "centroids", "options"}


def damage(content: bytes) -> dict[str, bytes]:
    positions = np.random.default_rng(0).integers(0, len(content), 30)
    flipped = {
        f"byte {i}": content[:i] + bytes([content[i] ^ 1]) + content[i + 1 :]
        for i in [0, 5, 30, *positions]
    }
    return {
        "empty": b"",
        "half": content[: len(content) // 2],
        "longer": content + b"\0",
        "other file": b"PK\3\4 something else",
        **flipped,
    }


def test_every_damage_of_a_checkpoint_is_found(reference: Path, tmp_path: Path) -> None:
    out = copy(reference, tmp_path)
    path = out / "checkpoint.bin"
    for name, content in damage(path.read_bytes()).items():
        path.write_bytes(content)
        before = snapshot(out)
        with pytest.raises(CheckpointError, match=r"checkpoint\.bin.*damaged"):
            run(out=out, resume=True)
        assert snapshot(out) == before, name
    path.unlink()  # as the message says
    run(out=out, resume=True)
    assert_same_results(out, reference)


def test_a_checkpoint_of_another_run_is_refused(
    reference: Path, tmp_path: Path
) -> None:
    out = tmp_path / "other"
    run(SMALL.replace(seed=1), out=out)
    (out / "checkpoint.bin").write_bytes((reference / "checkpoint.bin").read_bytes())
    with pytest.raises(CheckpointError, match="other settings"):
        run(SMALL.replace(seed=1), out=out, resume=True)


def test_another_writer_is_refused(reference: Path, tmp_path: Path) -> None:
    out = copy(reference, tmp_path)
    with (
        RunFolder(out).lock(),
        pytest.raises(ConfigError, match="another process is writing"),
    ):
        run(out=out, resume=True)


def test_another_machine_is_noticed(
    reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = copy(reference, tmp_path)
    document = json.loads((out / "config.json").read_text())
    document["environment"]["packages"]["jax"] = "0.1"
    (out / "config.json").write_text(json.dumps(document))
    run(out=out, resume=True, progress=True)
    assert "warning: jax was 0.1" in capsys.readouterr().err
    document["environment"]["x64"] = True
    (out / "config.json").write_text(json.dumps(document))
    with pytest.raises(ConfigError, match="jax_enable_x64"):
        run(out=out, resume=True)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"seed": -1}, "seed must be an integer, 0 to 4294967295; got -1"),
        ({"seed": 2**32}, "seed"),
        ({"seed": True}, "seed"),
        ({"iterations": -1}, "iterations must be an integer, at least 0; got -1"),
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
        ({"centroids": 10, "grid": (5, 5)}, "exclude"),
        ({"iso_sigma": float("nan")}, "iso_sigma"),
        ({"line_sigma": -0.1}, "line_sigma must be a finite number"),
        ({"env_name": ""}, "env_name"),
        ({"algorithm": 3}, "algorithm must be a name, got 3"),
        ({"options": 3}, "options must be names with values, got 3"),
        ({"colour": "red"}, "unknown setting 'colour'; known: algorithm, batch_size"),
    ],
)
def test_bad_settings_are_named(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        EvolveConfig().replace(**settings)


def test_a_grid_must_fit_the_descriptor(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with pytest.raises(ConfigError, match=r"5x5x5 has 3 dimensions.*'point' has 2"):
        run(SMALL.replace(grid=(5, 5, 5)), out=out)
    assert not out.exists()


def test_a_config_file_returns_the_settings(reference: Path) -> None:
    config, facts = read_config(reference / "config.json")
    assert config == SMALL
    assert facts["packages"]["jax"] == jax.__version__
    assert facts["x64"] is False


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "no 'settings'"),
        ('{"format": 9, "settings": {}}', "format 9"),
        ('{"format": 1, "settings": []}', "must be an object"),
        ('{"format": 1, "settings": {"seed": "a"}}', "seed must be an integer"),
        ('{"format": 1, "settings": {"sed": 1}}', "unknown setting 'sed'"),
        ('{"format": 1, "settings": {"seed": 1}}', "env_name is missing"),
        (
            '{"format": 1, "settings": {}, "environment": {"packages": null}}',
            "'environment' must be facts by name",
        ),
    ],
)
def test_bad_config_files(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "config.json"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_config(path)
    assert str(path) in str(caught.value)


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
    with pytest.raises(ConfigError, match=r"'ant' has no descriptor.*ant_uni"):
        make_task(EvolveConfig(env_name="ant"))


# --- display ---------------------------------------------------------------


def archive_of(grid: tuple[int, ...], empty: int = 0) -> Archive:
    """One individual in every cell but some; fitness counts the cells."""
    axes = [(np.arange(n) + 0.5) / n for n in grid]
    # QDax orders the cells like this: the first two axes are swapped.
    centroids = np.stack([m.ravel() for m in np.meshgrid(*axes)], axis=-1)
    fitnesses = np.arange(len(centroids), dtype=float)
    fitnesses[:empty] = -np.inf
    return Archive(np.zeros((len(centroids), 1)), fitnesses, centroids, centroids)


@pytest.mark.parametrize("grid", [(7,), (3, 4), (2, 3, 4), (3, 2, 4, 5), (2,) * 5])
@pytest.mark.parametrize("empty", [0, 2, 10**6])
def test_pictures_of_every_kind(grid: tuple[int, ...], empty: int) -> None:
    count = len(grid)
    figure = plot.plot_archive(
        archive_of(grid, empty),
        grid=grid,
        limits=(np.zeros(count), np.ones(count)),
        labels=tuple(f"foot_{i} contact" for i in range(count)),
        title="a title",
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    assert buffer.getvalue().startswith(b"\x89PNG")
    assert figure.get_suptitle() == "a title"
    written = " ".join(
        label
        for axes in figure.axes
        for panel in (axes, *axes.child_axes)
        for label in (panel.get_xlabel(), panel.get_ylabel())
    )
    assert "fitness" in written
    for i in range(count):
        assert f"foot_{i} contact" in written


def test_nested_picture_puts_every_cell_in_its_place() -> None:
    grid = (3, 2, 4, 5)
    archive = archive_of(grid, empty=1)
    figure = plot.plot_archive(
        archive,
        grid=grid,
        limits=(np.zeros(4), np.ones(4)),
        labels=("a", "b", "c", "d"),
    )
    image = figure.axes[0].images[0].get_array()
    assert image is not None and image.shape == (10, 12)
    assert np.ma.count_masked(image) == 1
    for centroid, fitness in zip(archive.centroids, archive.fitnesses, strict=True):
        a, b, c, d = (centroid * np.array(grid)).astype(int)
        if np.isfinite(fitness):
            assert image[b * 5 + d, a * 4 + c] == fitness


ROW = {"qd_score": 1234567.0, "coverage": 12.34, "max_fitness": 56.78}


class Terminal(io.StringIO):
    encoding = "utf-8"  # type: ignore[assignment]

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("columns", [20, 60, 80, 120, 300])
def test_bar_fits_the_terminal(monkeypatch: pytest.MonkeyPatch, columns: int) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    stream = Terminal()
    progress = Progress("ant_uni", 200, stream=stream)
    progress.update(0, ROW)
    progress.update(1, ROW)  # too soon after the first to be drawn
    progress.update(200, ROW)
    progress.close()
    drawn = stream.getvalue().split("\r")[1:]
    assert len(drawn) == 2 and stream.getvalue().endswith("\x1b[K\n")
    assert all(len(line.partition("\x1b")[0]) < columns for line in drawn)
    if columns >= 120:
        assert "QD score 1,234,567  coverage 12.3%  best 56.8" in drawn[1]
        assert "█" * 20 in drawn[1] and "200/200" in drawn[1]


def test_plain_lines_without_a_terminal() -> None:
    stream = io.StringIO()
    progress = Progress("ant_uni", 200, stream=stream)
    for iteration in range(201):
        progress.update(iteration, ROW)
    progress.close()
    lines = stream.getvalue().splitlines()
    assert len(lines) == 2 and "\r" not in stream.getvalue()
    assert lines[1].startswith("ant_uni 100%  200/200  QD score 1,234,567")


def test_quiet_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    run()
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err == ""
