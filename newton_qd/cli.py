"""The command ``newton-qd``: environments, evolution, and what gradients are worth."""

from __future__ import annotations

import argparse
import ast
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from newton_qd.errors import MissingExtra, UnknownEnvironment
from newton_qd.qd.checkpoint import CheckpointError
from newton_qd.qd.config import (
    ConfigError,
    EvolveConfig,
    changed_facts,
    environment_facts,
    read_config,
)
from newton_qd.qd.interrupt import INTERRUPTED, graceful_stop

if TYPE_CHECKING:
    from newton_qd.qd.evolve import EvolveResult
    from newton_qd.qd.task import Task

OK, FAILED, BAD_ARGUMENTS = 0, 1, 2

_DEFAULTS = EvolveConfig()


def main(
    argv: Sequence[str] | None = None,
    *,
    task_factory: Callable[[EvolveConfig], Task] | None = None,
) -> int:
    """Runs the command line.

    Args:
        argv: Arguments without the name of the program; those of the process by
            default.
        task_factory: Makes the task of ``evolve``; by default from the registered
            environments.

    Returns:
        Exit code: 0 success, 1 failure, 2 bad arguments, 130 interrupted and saved.
    """
    arguments = _make_parser().parse_args(argv)
    try:
        if arguments.command == "envs":
            return _envs()
        if arguments.command == "doctor":
            return _doctor(arguments)
        return _evolve(arguments, task_factory)
    except (ConfigError, UnknownEnvironment) as error:
        return _complain(arguments, error, BAD_ARGUMENTS)
    except (CheckpointError, MissingExtra, OSError) as error:
        return _complain(arguments, error, FAILED)
    except KeyboardInterrupt:
        return _complain(arguments, "interrupted", INTERRUPTED)


def _complain(arguments: argparse.Namespace, what: object, code: int) -> int:
    print(f"newton-qd {arguments.command}: error: {what}", file=sys.stderr)
    return code


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="newton-qd", description="Quality-Diversity on differentiable physics."
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    commands.add_parser("envs", help="list the environments")
    evolve = commands.add_parser(
        "evolve",
        help="run an algorithm of MAP-Elites' family on an environment",
        description="Evolves an archive of policies and writes a results folder: "
        "archive.npz, archive.png, metrics.csv, config.json and a checkpoint.",
    )
    _add_run_arguments(evolve)
    _add_setting_arguments(evolve)
    doctor = commands.add_parser("doctor", help="measure what gradients are worth")
    ailments = doctor.add_subparsers(dest="ailment", required=True, metavar="WHAT")
    _add_doctor_arguments(
        ailments.add_parser(
            "gradients",
            help="over how many control steps a gradient can be used, and why",
            description="Compares the gradient of the return with central differences "
            "and with an evolution strategy, horizon by horizon.",
        )
    )
    return parser


def _add_doctor_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("env_name", metavar="ENV", help="environment, as ant_uni")
    parser.add_argument(
        "--horizons",
        type=_widths,
        default=(1, 2, 4, 8, 16, 32, 64),
        metavar="N,N",
        help="numbers of control steps (default: 1,2,4,8,16,32,64)",
    )
    for name, default, text in (
        ("worlds", 8, "random plans of actions"),
        ("directions", 8, "directions of the differences, in each world"),
        ("samples", 16, "pairs of noisy samples, in each world"),
        ("seed", 0, "seed of every random number"),
    ):
        parser.add_argument(
            f"--{name}",
            type=int,
            default=default,
            metavar="N",
            help=f"{text} (default: {default})",
        )
    parser.add_argument(
        "--sigma",
        type=float,
        default=0.05,
        metavar="X",
        help="standard deviation of the noise on actions (default: 0.05)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="folder for horizons.csv, contacts.csv, report.txt and gradients.png",
    )


def _add_run_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "env_name",
        nargs="?",
        metavar="ENV",
        help="environment, for example ant_uni (see newton-qd envs)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="results folder (default: results/ENV-seedSEED)",
    )
    parser.add_argument(
        "--resume",
        action="store_true",
        help="continue the run in the folder, with its settings; starts it if there "
        "is none yet",
    )
    parser.add_argument(
        "--config",
        type=Path,
        metavar="FILE",
        help="take the settings of an earlier run's config.json, or of a TOML file",
    )
    parser.add_argument(
        "--checkpoint-seconds",
        type=float,
        default=5.0,
        metavar="S",
        help="least time between two checkpoints (default: 5)",
    )
    parser.add_argument("--quiet", action="store_true", help="show no progress")


def _add_setting_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("settings (they determine the result)")
    for name, kind, text in (
        ("seed", int, "seed of every random number"),
        ("iterations", int, "generations after the initial population"),
        ("batch_size", int, "individuals evaluated in one generation"),
        ("episode_length", int, "control steps of one evaluation"),
        ("iso_sigma", float, "isotropic part of the variation"),
        ("line_sigma", float, "part of the variation towards a second parent"),
        ("reevaluations", int, "evaluations of each elite for corrected metrics"),
    ):
        group.add_argument(
            f"--{name.replace('_', '-')}",
            type=kind,
            metavar="N" if kind is int else "X",
            help=f"{text} (default: {getattr(_DEFAULTS, name)})",
        )
    group.add_argument(
        "--algorithm",
        metavar="NAME",
        help=f"me, cma-me, pga-me or me-es (default: {_DEFAULTS.algorithm})",
    )
    group.add_argument(
        "--option",
        dest="options",
        type=_option,
        action="append",
        metavar="NAME=VALUE",
        help="setting that the algorithm alone has, for example discount=0.95; may be "
        "repeated",
    )
    group.add_argument(
        "--hidden",
        type=_widths,
        metavar="N,N",
        help="hidden layers of the policy, 'none' for a linear one (default: "
        f"{','.join(map(str, _DEFAULTS.hidden))})",
    )
    cells = group.add_mutually_exclusive_group()
    cells.add_argument(
        "--grid",
        type=_grid,
        metavar="NxN",
        help="cells along each descriptor dimension (default for four: 5x5x5x5)",
    )
    cells.add_argument(
        "--centroids",
        type=int,
        metavar="N",
        help="cells of a centroidal Voronoi tessellation instead of a grid",
    )


def _option(text: str) -> tuple[str, Any]:
    name, separator, value = text.partition("=")
    try:
        if name and separator:
            return name, ast.literal_eval(value)
    except (SyntaxError, ValueError):
        pass
    raise argparse.ArgumentTypeError(
        f"expected a name and a value like discount=0.95, got {text!r}"
    )


def _widths(text: str) -> tuple[int, ...]:
    return () if text == "none" else _integers(text, ",")


def _grid(text: str) -> tuple[int, ...]:
    return _integers(text, "x")


def _integers(text: str, separator: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(separator))
    except ValueError as error:
        example = separator.join(("8", "8"))
        raise argparse.ArgumentTypeError(
            f"expected integers like {example}, got {text!r}"
        ) from error


def _envs() -> int:
    """Prints a table of the registered environments."""
    import newton_qd
    from newton_qd.physics.precision import quiet

    quiet()
    rows = [("name", "observation", "action", "descriptor", "reward offset")]
    for name in newton_qd.registered_envs():
        env: Any = newton_qd.create(name)
        descriptor = offset = "-"
        if name in newton_qd.descriptor_extractor:
            descriptor = f"{env.state_descriptor_name} ({env.descriptor_length})"
            offset = f"{newton_qd.reward_offset[name]:g}"
        sizes = str(env.observation_size), str(env.action_size)
        rows.append((name, *sizes, descriptor, offset))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        print("  ".join(cells).rstrip())
    return OK


def _doctor(arguments: argparse.Namespace) -> int:
    """Prints a report, and writes it where asked."""
    import newton_qd
    from newton_qd.physics.precision import quiet

    quiet()
    try:
        report = newton_qd.diagnose_gradients(
            arguments.env_name,
            horizons=arguments.horizons,
            worlds=arguments.worlds,
            directions=arguments.directions,
            samples=arguments.samples,
            sigma=arguments.sigma,
            seed=arguments.seed,
        )
    except ValueError as error:
        return _complain(arguments, error, BAD_ARGUMENTS)
    print(report)
    if arguments.out is not None:
        report.write(arguments.out)
        print(f"written to {arguments.out}")
    return OK


def _evolve(
    arguments: argparse.Namespace,
    task_factory: Callable[[EvolveConfig], Task] | None,
) -> int:
    config, out = _settle(arguments)
    if not arguments.checkpoint_seconds >= 0:
        raise ConfigError(
            "checkpoint_seconds must be at least 0, got "
            f"{arguments.checkpoint_seconds!r}"
        )
    # Imports JAX and the physics: an argument error above does not wait for it. An
    # exception in the middle of an extension module's import could end in a crash.
    with graceful_stop(b"\nstopping\n") as stop:
        from newton_qd.physics.precision import quiet
        from newton_qd.qd.evolve import evolve
        from newton_qd.qd.search import SearchError
        from newton_qd.qd.task import make_task
    if stop.requested:
        raise KeyboardInterrupt
    quiet()
    try:
        result = evolve(
            config,
            out=out,
            resume=arguments.resume,
            progress=not arguments.quiet,
            checkpoint_seconds=arguments.checkpoint_seconds,
            task_factory=make_task if task_factory is None else task_factory,
        )
    except SearchError as error:
        return _complain(arguments, error, FAILED)
    _report(result, out)
    return INTERRUPTED if result.interrupted else OK


def _settle(arguments: argparse.Namespace) -> tuple[EvolveConfig, Path]:
    """Combines arguments, config file and the run to resume.

    Raises:
        ConfigError: They do not name an environment, or a setting is wrong.
    """
    from newton_qd.qd.folder import CONFIG, RunFolder

    names = vars(_DEFAULTS)
    given = {
        name: value
        for name, value in vars(arguments).items()
        if name in names and value is not None
    }
    base = None
    if arguments.config is not None:
        base, facts = read_config(arguments.config)
        _warn_of_changes(facts)
    out = arguments.out
    if out is None:
        named = (base or _DEFAULTS).replace(**given)
        if base is None and "env_name" not in given:
            raise ConfigError("name an environment, for example: evolve ant_uni")
        out = Path("results") / f"{named.env_name}-seed{named.seed}"
    folder = RunFolder(out)
    folder.check(resume=arguments.resume)
    if base is None and arguments.resume and folder.has_config:
        base = read_config(out / CONFIG)[0]
    if base is None and "env_name" not in given:
        raise ConfigError("name an environment, for example: evolve ant_uni")
    base = base or _DEFAULTS
    # A new choice of cells replaces the other kind of cells.
    if "grid" in given:
        base = base.replace(centroids=None)
    if "centroids" in given:
        base = base.replace(grid=None)
    if "options" in given:
        given["options"] = {**dict(base.options), **dict(given["options"])}
    return base.replace(**given), out


def _warn_of_changes(facts: dict[str, Any]) -> None:
    for name, old, new in changed_facts(facts, environment_facts()) if facts else ():
        print(
            f"warning: {name} was {old} when this config was written and is {new} "
            "now; the result may differ",
            file=sys.stderr,
        )


def _report(result: EvolveResult, out: Path) -> None:
    """Prints what the run has found and how to go on."""
    config = result.config
    if result.iteration >= 0:
        first, last = (
            {name: values[index] for name, values in result.metrics.items()}
            for index in (0, -1)
        )
        print(
            f"{config.env_name}: {last['evaluations']:,.0f} evaluations in "
            f"{result.iteration} generations; this call took {result.seconds:.0f} s"
        )
        print(
            f"QD score {first['qd_score']:,.0f} -> {last['qd_score']:,.0f}, "
            f"coverage {first['coverage']:.1f} -> {last['coverage']:.1f} %, "
            f"best fitness {first['max_fitness']:.1f} -> {last['max_fitness']:.1f}"
        )
        if (corrected := result.corrected) is not None:
            print(
                f"corrected ({corrected.reevaluations} evaluations of each elite): "
                f"QD score {corrected.qd_score:,.0f}, coverage "
                f"{corrected.coverage:.1f} %, best fitness {corrected.max_fitness:.1f}"
            )
        print(f"results in {out}")
    if result.interrupted:
        when = "before the initial population"
        if result.iteration >= 0:
            when = (
                f"after generation {result.iteration} of {config.iterations}, "
                "everything up to it is saved"
            )
        print(
            f"interrupted {when}; continue with:\n"
            f"  newton-qd evolve --resume --out {shlex.quote(str(out))}"
        )


if __name__ == "__main__":
    sys.exit(main())
