"""Compare gradient-based emitters with gradient-free ones on the environments.

Every run, of one task, algorithm and seed, has the same budget of seconds: processor
seconds on a CPU, which depend on what else the machine does only as far as cores share
caches and memory, and wall-clock seconds on a GPU. Compilation is left out: all
functions run once on a state that is thrown away before the clock starts. What
evaluates the elites again, for metrics without luck, runs after the clock has stopped.

A run is a process of its own and writes one csv file when it is finished; runs whose
file exists are left out, so that a study can be stopped and continued. Settings of
tasks are in ``study/TASK.toml``, those of algorithms in ``study/variants.toml``. Which
variant is best on a task is found first, with another seed:

    python benchmarks/study.py --tune --seconds 20 --workers 2 --out tuning
    python benchmarks/study.py --tuned tuning --seconds 60 --workers 2 --out runs
    python benchmarks/study_report.py runs --out benchmarks/results/study.csv

With ``--workers N`` N runs go on at once, on a CPU each with its share of the cores, on
GPUs in turn on each of them. Runs of a protocol below that share a GPU compile and warm
up together, and then take turns: while one has its clock running, the others wait.

All this is the protocol ``core``, for one core of a CPU. ``study_protocols.py`` has two
more. ``field`` is that of published comparisons, for one GPU: a million evaluations in
batches of 1,024, and scores after 60, 250 and 1,000 s. ``small`` has the same policies,
episodes and cells, for minutes on a CPU. Their runs can be stopped at any time and
continued, see ``study_execution.py``; variants are in ``study/field.toml``:

    python benchmarks/study.py --protocol field --device cuda --until 60 --out field
    python benchmarks/study.py --protocol small --out small
    python benchmarks/study_scores.py small

``--until S`` leaves later stops for another command, which continues the runs. With
``--reach-evaluations``, runs go on after that until they have a million evaluations.
``--stop-after S`` ends the command in time for a machine that is lent for so long.
With ``--paced``, the runs of a GPU do not take turns: see ``study_clock.py``.

``--list FILE`` has runs of several tasks, variants and times, the most informative
first: a line of it is ``TASK VARIANT SEED UNTIL``. The file is read again whenever a
run ends, so it can be changed meanwhile.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import study_core
import study_execution
import study_runs
from study_pool import Pool
from study_protocols import PROTOCOLS

INTERRUPTED = 130
"""Exit code after Ctrl-C, as in shells."""


def arguments() -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--protocol", choices=("core", *PROTOCOLS), default="core")
    parser.add_argument("--out", type=Path, default=Path("runs"))
    parser.add_argument("--tasks", nargs="*", help="default: all of the protocol")
    parser.add_argument("--algorithms", nargs="*", help="default: all of the protocol")
    parser.add_argument(
        "--seeds", type=int, help="at most so many; default: 5, or as the protocol says"
    )
    _add_field_arguments(parser)
    parser.add_argument("--seconds", type=float, help="time of a run of core: 60")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--gpus", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument(
        "--start-until",
        type=float,
        default=math.inf,
        help="start no run later than so many seconds after the command",
    )
    parser.add_argument(
        "--tune", action="store_true", help="run every variant, with a seed of its own"
    )
    parser.add_argument("--tuned", type=Path, help="folder of what --tune has found")
    parser.add_argument("--cores", type=int, nargs="*", help=argparse.SUPPRESS)
    parser.add_argument(
        "--run",
        nargs=4,
        metavar=("TASK", "VARIANT", "SEED", "OUT"),
        help="carry out one run in this process, into this folder",
    )
    return checked(parser, parser.parse_args())


def _add_field_arguments(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("of the protocols field and small")
    group.add_argument("--variants", nargs="*", help="run these, as for ablations")
    group.add_argument("--list", type=Path, help="file of the runs, see above")
    group.add_argument("--until", type=float, help="longest time of a run [s]")
    group.add_argument(
        "--reach-evaluations",
        action="store_true",
        help="go on after --until to the number of evaluations",
    )
    group.add_argument(
        "--stop-after",
        type=float,
        default=math.inf,
        help="stop all runs so many seconds after the command",
    )
    group.add_argument(
        "--paced",
        action="store_true",
        help="runs share a GPU; their clock is the number of "
        "generations times the time of a generation alone",
    )
    group.add_argument(
        "--no-states",
        action="store_true",
        help="save no states, which takes time if they are large; who "
        "continues a run begins it again",
    )


def checked(
    parser: argparse.ArgumentParser, args: argparse.Namespace
) -> argparse.Namespace:
    """Fills in the protocol's defaults, and ends the command at an unknown name."""
    protocol = PROTOCOLS.get(args.protocol)
    args.tasks = args.tasks or list(protocol.tasks if protocol else study_core.TASKS)
    args.algorithms = args.algorithms or list(
        protocol.algorithms if protocol else study_core.ALGORITHMS
    )
    known = {
        "tasks": protocol.tasks if protocol else study_core.TASKS,
        "algorithms": protocol.algorithms if protocol else study_core.algorithms(),
    }
    for name, allowed in known.items():
        unknown = sorted(set(getattr(args, name)) - set(allowed))
        if unknown:
            parser.error(
                f"--{name}: got {', '.join(unknown)}; allowed: {', '.join(allowed)}"
            )
    unknown = sorted(set(args.variants or ()) - set(study_runs.variants()))
    if protocol and unknown:
        allowed = ", ".join(study_runs.variants())
        parser.error(f"--variants: got {', '.join(unknown)}; allowed: {allowed}")
    if args.variants and not protocol:
        parser.error("--variants: got it without --protocol field or small")
    if args.run:
        _check_run(parser, args)
    if args.seeds is None:
        args.seeds = protocol.seeds if protocol else 5
    _check_times(parser, args)
    if args.list:
        if not protocol:
            parser.error("--list: got it without --protocol field or small")
        try:
            study_runs.listed(args.list, protocol, args.out)
        except (OSError, ValueError) as error:
            parser.error(f"--list: {error}")
    if args.paced and (not protocol or args.device != "cuda"):
        parser.error("--paced: got it without --protocol field or small and a GPU")
    for name in ("seeds", "gpus", "workers"):
        value = getattr(args, name)
        if value < 1:
            parser.error(f"--{name}: got {value}; allowed: an integer from 1")
    _check_folders(parser, args)
    return args


def _check_run(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Ends the command at a wrong word of ``--run``."""
    protocol = PROTOCOLS.get(args.protocol)
    tasks = protocol.tasks if protocol else study_core.TASKS
    variants = study_runs.variants() if protocol else study_core.read("variants")
    task, variant, seed, _ = args.run
    for value, known, sound in (
        (task, tasks, task in tasks),
        (variant, variants, variant in variants),
        (seed, ("an integer from 0",), seed.isdecimal()),
    ):
        if not sound:
            parser.error(f"--run: got {value}; allowed: {', '.join(known)}")


def _check_folders(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Ends the command if a folder has not the runs that it should have."""
    protocol = PROTOCOLS.get(args.protocol)
    out = Path(args.run[3]) if args.run else args.out
    if protocol and (others := study_runs.other_protocols(protocol, out)):
        # files of cells and states have no name of a protocol
        names = ", ".join(sorted(others))
        parser.error(f"--out: got {out}; allowed: a folder without runs of {names}")
    if args.tuned and not args.run:
        try:
            left(args)
        except FileNotFoundError as error:
            parser.error(f"--tuned: {error}")


def _check_times(parser: argparse.ArgumentParser, args: argparse.Namespace) -> None:
    """Fills in the times of a protocol, and ends the command at a wrong one."""
    protocol = PROTOCOLS.get(args.protocol)
    if protocol and args.seconds is not None:
        parser.error("--seconds: got it without --protocol core; use --until")
    if not protocol and args.until is not None:
        parser.error("--until: got it with --protocol core; use --seconds")
    stops = [x.amount for x in protocol.stops if x.unit == "s"] if protocol else []
    args.seconds = 60.0 if args.seconds is None else args.seconds
    args.until = max(stops, default=math.inf) if args.until is None else args.until
    for name in ("seconds", "until", "stop_after", "start_until"):
        value = getattr(args, name)
        if not value > 0:
            option = name.replace("_", "-")
            parser.error(f"--{option}: got {value}; allowed: a number above 0")
    # a shorter run would reach none of them, and its work would be lost
    if args.until < min(stops, default=0.0) and not args.reach_evaluations:
        allowed = ", ".join(f"{x:g}" for x in stops)
        parser.error(f"--until: got {args.until:g}; allowed: {allowed}")


def coming(args: argparse.Namespace) -> Iterator[tuple[float, tuple[str, ...]]]:
    """Longest time of each run [s], and its task, variant, seed and output.

    While a list has a wrong line, what it had before counts.
    """
    if not args.list:
        for what in left(args):
            yield args.until, what
        return
    begun: set[tuple[study_runs.Run, float]] = set()
    found: list[tuple[study_runs.Run, float]] = []
    while True:
        try:
            found = study_runs.listed(args.list, PROTOCOLS[args.protocol], args.out)
        except (OSError, ValueError) as error:
            print(f"--list: {error}", file=sys.stderr, flush=True)
        found = [each for each in found if each not in begun]
        if not found:
            return
        begun.add(found[0])
        run, until = found[0]
        yield until, (run.task, run.variant, str(run.seed), str(args.out))


def left(args: argparse.Namespace) -> list[tuple[str, ...]]:
    """Task, variant, seed and output of the runs that are not finished."""
    if args.protocol == "core":
        return [
            (run.task, run.variant, str(run.seed), str(file))
            for run, file in study_core.planned(args)
            if not file.exists()
        ]
    choice = study_runs.Choice(
        tasks=args.tasks,
        algorithms=args.algorithms,
        seeds=args.seeds,
        until=args.until,
        reach=args.reach_evaluations,
        tune=args.tune,
        tuned=args.tuned,
        variants=args.variants,
    )
    found = study_runs.missing(PROTOCOLS[args.protocol], args.out, choice)
    return [(run.task, run.variant, str(run.seed), str(args.out)) for run in found]


def one(args: argparse.Namespace, begin: float) -> None:
    """Carries out one run, and ends the command if its device is not there."""
    task, variant, seed, out = args.run
    if args.device == "cuda":
        import jax

        # JAX falls back to the processor; the row would name the wrong device
        if jax.default_backend() != "gpu":
            sys.exit("study.py: --device: got cuda; allowed: cpu, JAX has no GPU here")
    if args.protocol == "core":
        run = study_core.Run(task, variant, int(seed))
        study_core.execute(run, args.seconds, args.device, Path(out))
        return
    study_execution.execute(
        PROTOCOLS[args.protocol],
        study_runs.Run(task, variant, int(seed)),
        Path(out),
        study_execution.Limits(
            args.until,
            args.reach_evaluations,
            begin + args.stop_after,
            args.paced,
            not args.no_states,
        ),
        args.device,
    )


def main() -> None:
    """Runs what is missing."""
    begin, args = time.monotonic(), arguments()
    if args.cores:
        os.sched_setaffinity(0, args.cores)
    if args.run:
        one(args, begin)
        return
    args.out.mkdir(parents=True, exist_ok=True)
    pool = Pool(args, [None] * args.workers, args.gpus)
    try:
        carry_out(args, pool, begin)
    except KeyboardInterrupt:
        pool.stop()
        print("stopped: the same command continues", flush=True)
        sys.exit(INTERRUPTED)
    if pool.failed:
        sys.exit(1)


def carry_out(args: argparse.Namespace, pool: Pool, begin: float) -> None:
    """Starts the runs, and waits for them.

    Args:
        args: Arguments of the command.
        pool: The processes.
        begin: ``time.monotonic()`` when the command began [s].
    """
    latest = min(args.start_until, args.stop_after)
    runs, begun = coming(args), False
    while True:
        slot = pool.wait()
        spent = time.monotonic() - begin
        until, what = next(runs, (0.0, ()))
        if not what:
            if not begun:
                print("no run is left", flush=True)
            break
        if spent > latest:
            print(f"{1 + sum(1 for _ in runs)} runs are left", flush=True)
            break
        begun = True
        print(f"{spent:5.0f} s: {what} until {until:g} s", flush=True)
        if args.protocol == "core":
            more = ["--seconds", str(args.seconds)]
        else:
            more = ["--until", str(until)]
            more += ["--stop-after", str(args.stop_after - spent)]
            more += ["--reach-evaluations"] * args.reach_evaluations
            more += ["--paced"] * args.paced
            more += ["--no-states"] * args.no_states
        pool.start(slot, *more, "--run", *what)
    pool.drain()


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
