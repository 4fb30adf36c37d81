"""A run from its settings to its results: folder, checkpoints, interrupts."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from newton_qd import checks
from newton_qd.checks import Fact, message
from newton_qd.errors import require_extra
from newton_qd.physics import interrupts
from newton_qd.qd.algorithms import algorithm_named
from newton_qd.qd.algorithms.gradient_options import check_smoothed
from newton_qd.qd.config import ConfigError, EvolveConfig
from newton_qd.qd.facts import environment_facts
from newton_qd.qd.run.archive import archive_of
from newton_qd.qd.run.checkpoint import Checkpoint
from newton_qd.qd.run.evolve_result import EvolveResult
from newton_qd.qd.run.folder import COLUMNS, EVENTS, RunFolder
from newton_qd.qd.run.interrupt import StopFlag, graceful_stop
from newton_qd.qd.run.loop import Saver, run_generations
from newton_qd.qd.run.plot import archive_png
from newton_qd.qd.run.progress import Progress
from newton_qd.qd.run.search import Search, SearchState
from newton_qd.qd.run.sizes import check_memory
from newton_qd.qd.run.tensorboard import EventLog
from newton_qd.qd.run.warm_start import StartFrom, digest_of, start_genotypes
from newton_qd.qd.scoring.networks import policy_for
from newton_qd.qd.scoring.sharding import device_mesh, device_named
from newton_qd.qd.scoring.task import Task, made_task, make_task, randomized


def evolve(
    config: EvolveConfig,
    *,
    out: str | os.PathLike[str] | None = None,
    resume: bool = False,
    start_from: StartFrom = None,
    progress: bool = True,
    tensorboard: bool = False,
    checkpoint_seconds: float = 5.0,
    devices: int | None = None,
    device: str | None = None,
    task_factory: Callable[[EvolveConfig], Task] = make_task,
) -> EvolveResult:
    """Evolves an archive of policies with an algorithm of the MAP-Elites family.

    SIGINT and SIGTERM end the run after the current generation, or end the
    re-evaluation. The state is saved, and ``interrupted`` is true in the result.

    Args:
        config: Settings.
        out: Results folder to create; ``None`` writes no files.
        resume: Whether to continue the run in ``out``. Without a run, a new one starts.
            The run goes on beyond its end if ``config`` has more generations.
        start_from: Archive whose elites become the initial population: a results
            folder, a ``Run``, an ``EvolveResult``, an ``Archive``, a repertoire of QDax
            or an archive of pyribs. They are evaluated on the task of this run.
            ``None``: a random population.
        progress: Whether to show progress on standard error.
        tensorboard: Whether to write the metrics for TensorBoard too.
        checkpoint_seconds: Shortest time between two checkpoints [s], which becomes
            longer where a checkpoint takes long; 0: one after each generation;
            infinite: one at the end. It does not change the result.
        devices: Number of devices that share each evaluation. It does not change the
            result, except that of ``cma-maega-actor-critic``, whose actors have other
            rounding errors on several devices. ``None``: only the default device.
        device: Device of the whole run, such as ``"cpu"``, ``"gpu"`` or ``"gpu:1"``;
            ``None``: JAX's default device.
        task_factory: Makes the task; by default from registered environments.

    Returns:
        Archive and metrics.

    Raises:
        ConfigError: A setting is wrong, the folder is in use, or the run to resume has
            other settings.
        UnknownEnvironment: No environment of this name is registered.
        ArchiveError: The archive in the folder ``start_from`` is damaged.
        CheckpointError: The checkpoint of the run to resume is damaged.
        MissingExtra: QDax, matplotlib or tensorboardX is not installed.
        SearchError: No individual of the initial population has finite scores.
    """
    begin = time.monotonic()
    flags = {"resume": resume, "progress": progress, "tensorboard": tensorboard}
    _check_arguments(config, checkpoint_seconds, flags)
    algorithm = algorithm_named(config.algorithm)
    options = algorithm.read_options(config)
    mesh = _mesh(devices, resume)
    chosen = _device(device, devices)
    # after the other arguments, whose errors would come one by one otherwise
    folder = _folder(out, config, resume, tensorboard)
    new = folder is None or not folder.has_config
    if new:
        algorithm.check_effect(config)
    interrupts.install()  # before the handlers below, so that it outlives them
    with ExitStack() as stack:
        stop = stack.enter_context(graceful_stop())
        stack.enter_context(jax.default_device(chosen))
        task = made_task(task_factory, config)
        if new:
            check_smoothed(config, options, task)
        config = config.resolve(task.descriptor_length)
        check_memory(config, task, chosen)
        config, start = _started(config, start_from, task, folder)
        if folder is not None and folder.has_config:
            folder.compare(config)  # before the slow part
        task = randomized(config, task)
        search = Search(config, task, mesh)
        display = Progress(config.env_name, config.iterations, enabled=progress)
        stack.callback(display.close)
        if folder is not None:
            stack.enter_context(folder.lock())
        state = _first(search, folder, config, start, resume, display)
        watchers = [display.update]
        if folder is not None and tensorboard:
            log = EventLog(folder.path / EVENTS, state.iteration + 1)
            watchers.append(stack.enter_context(log).write)
        save = Saver(search, folder, checkpoint_seconds)
        state = run_generations(search, state, config.iterations, watchers, stop, save)
        result = _result(config, search.checkpoint(state), folder, begin)
        return _finished(result, search, task, folder, display, stop, begin)


def _check_arguments(
    config: EvolveConfig, checkpoint_seconds: float, flags: Mapping[str, bool]
) -> None:
    """Checks the arguments that need no other one.

    Raises:
        ConfigError: One of them is wrong.
    """
    allowed = "an EvolveConfig, such as EvolveConfig(env_name='ant_uni')"
    checks.instance("config", config, EvolveConfig, allowed, error=ConfigError)
    name, seconds = "checkpoint_seconds", checkpoint_seconds
    checks.number(name, seconds, least=0, endless=True, error=ConfigError)
    for name, value in flags.items():
        checks.flag(name, value, error=ConfigError)


def _folder(
    out: str | os.PathLike[str] | None,
    config: EvolveConfig,
    resume: bool,
    tensorboard: bool,
) -> RunFolder | None:
    """Checks folder and packages before the slow part of a run.

    Raises:
        ConfigError: The folder is in use, its run is of another environment, or there
            is none for TensorBoard's files or a run to resume.
        MissingExtra: QDax, matplotlib or tensorboardX is not installed.
    """
    require_extra("qdax", "qd")
    if out is None:
        for name, given in (("tensorboard", tensorboard), ("resume", resume)):
            if given:
                raise ConfigError(message(name, True, "with a results folder (out)"))
        return None
    folder = RunFolder(out)
    folder.check(resume=resume)
    folder.compare_environment(config.env_name)
    require_extra("matplotlib", "viz")
    if tensorboard:
        require_extra("tensorboardX", "tensorboard")
    return folder


def _started(
    config: EvolveConfig, start_from: StartFrom, task: Task, folder: RunFolder | None
) -> tuple[EvolveConfig, np.ndarray | None]:
    """Returns the settings, and the genotypes (N, size) that the run starts from.

    Raises:
        ArchiveError: The archive in the folder ``start_from`` is damaged.
        CheckpointError: A file of the run to resume, or of ``start_from``, is damaged.
        ConfigError: ``start_from`` does not fit the policy, is missing, or is another
            archive than that of the settings.
    """
    start = None
    if start_from is not None:
        start = start_genotypes(start_from, policy_for(task, config.hidden))
    elif config.warm_start is not None and folder is not None:
        start = folder.start_genotypes()
    if start is None:
        if config.warm_start is not None and not (folder and folder.has_config):
            raise ConfigError(_other_start(config, "nothing"))
        return config, None
    found = digest_of(start)
    if config.warm_start not in (None, found):
        given = f"genotypes with SHA-256 {found}"
        raise ConfigError(_other_start(config, given))
    return config.replace(warm_start=found), start


def _other_start(config: EvolveConfig, given: str) -> str:
    allowed = f"the archive with SHA-256 {config.warm_start}, as the settings say"
    return message("start_from", Fact(given), allowed)


def _mesh(devices: int | None, resume: bool) -> Mesh | None:
    """Returns the devices that share the evaluations; ``None``: the default device.

    Raises:
        ConfigError: There are too few devices, or several processes resume a run.
    """
    if resume and jax.process_count() > 1:
        why = f"with {jax.process_count()} processes"
        allowed = "with a single process"
        raise ConfigError(message("resume", True, allowed, why=why))
    if devices is None:
        return None
    most = len(jax.devices())
    checks.integer("devices", devices, most=most, error=ConfigError)
    return device_mesh(devices)


def _device(device: str | None, devices: int | None) -> Any:
    """Returns the device of a run; ``None``: the default device.

    Raises:
        ConfigError: It does not exist, or several devices are asked for too.
    """
    if device is None:
        return None
    if devices is not None:
        given = (device, devices)
        raise ConfigError(message("device, devices", given, "one of the two"))
    try:
        return device_named(device)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _first(
    search: Search,
    folder: RunFolder | None,
    config: EvolveConfig,
    start: np.ndarray | None,
    resume: bool,
    display: Progress,
) -> SearchState:
    """Returns the state at the start of this call.

    Raises:
        CheckpointError: The checkpoint does not fit this version of the algorithm.
        ConfigError: The genotypes that the run starts from are missing.
    """
    checkpoint = None
    resumed = folder is not None and folder.has_config
    if folder is not None:
        checkpoint = _open(folder, config, start, resume, display)
    if checkpoint is not None:
        state = search.restore(checkpoint)
    elif config.warm_start is not None and start is None:
        raise ConfigError(_other_start(config, "nothing"))
    else:
        state = search.empty(start)
        if start is not None:
            display.note(f"starting from {len(start)} elites of another archive")
    if folder is not None and resumed:
        # not before its state is known to fit
        folder.go_on(config, anew=checkpoint is None)
    if state.iteration < config.iterations:
        display.note("compiling the physics and the rollout (longer on a first start)")
        if checkpoint is not None:
            _warn_of_another_task(search, checkpoint, display)
    return state


def _warn_of_another_task(
    search: Search, checkpoint: Checkpoint, display: Progress
) -> None:
    """Says whether elites have other results than before the stop.

    A module may have the same task with another reward. The evaluation is that of a
    generation, so it needs no other compiling.
    """
    changed, count = search.changed(checkpoint)
    if changed:
        display.note(
            f"warning: {changed} of {count} elites now have other results than in the "
            "archive. If the task has changed, start a new run in another folder. "
            "(Other software, another machine or a GPU can change the last digits, and "
            "such a change grows during an episode.)"
        )


def _open(
    folder: RunFolder,
    config: EvolveConfig,
    start: np.ndarray | None,
    resume: bool,
    display: Progress,
) -> Checkpoint | None:
    """Starts a new run in the folder, or reads the state of the run in it."""
    # Another process may have started a run here after the first check.
    folder.check(resume=resume)
    facts = environment_facts()
    if not folder.has_config:
        if resume:
            display.note(f"no run in {folder.path} yet: starting it")
        folder.start(config, facts, start)
        return None
    checkpoint, warnings = folder.restore(config, facts)
    for warning in warnings:
        display.note(warning)
    done = "before the initial population"
    if checkpoint is not None:
        done = f"after generation {checkpoint.iteration} of {config.iterations}"
    display.note(f"resuming {folder.path} {done}")
    return checkpoint


def _result(
    config: EvolveConfig,
    checkpoint: Checkpoint,
    folder: RunFolder | None,
    begin: float,
) -> EvolveResult:
    columns = checkpoint.metrics.T
    return EvolveResult(
        config=config,
        archive=archive_of(checkpoint),
        metrics=dict(zip(COLUMNS, columns, strict=True)),
        iteration=checkpoint.iteration,
        interrupted=checkpoint.iteration < config.iterations,
        out=None if folder is None else folder.path,
        seconds=time.monotonic() - begin,
    )


def _finished(
    result: EvolveResult,
    search: Search,
    task: Task,
    folder: RunFolder | None,
    display: Progress,
    stop: StopFlag,
    begin: float,
) -> EvolveResult:
    """Writes the last files, and adds the metrics of re-evaluated elites."""
    if folder is not None and result.iteration >= 0:
        picture = archive_png(result.archive, result.config, task, result.iteration)
        folder.save_archive(result.archive, picture)
    if result.interrupted or not result.config.reevaluations:
        seconds = time.monotonic() - begin
        return dataclasses.replace(result, seconds=seconds)
    display.note("evaluating the elites again, for metrics without luck")
    first = float(result.metrics["initial_fitness"][0])
    again = search.reevaluate(
        result.archive,
        lambda: stop.requested,
        untrained=first if np.isfinite(first) else None,
    )
    if folder is not None and again is not None:
        folder.save_reevaluated(dataclasses.asdict(again))
    return dataclasses.replace(
        result,
        reevaluated=again,
        interrupted=again is None,
        seconds=time.monotonic() - begin,
    )
