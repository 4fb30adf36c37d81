"""``newton-qd doctor gradients``: measures where gradients are useful."""

from __future__ import annotations

import argparse
from pathlib import Path

from newton_qd.cli import health, modules
from newton_qd.cli.arguments import (
    BAD_ARGUMENTS,
    OK,
    Commands,
    complain,
    require_writable,
    say,
    widths,
)


def add_parser(commands: Commands) -> None:
    """Adds the command to the subparsers of ``newton-qd``."""
    doctor = commands.add_parser(
        "doctor",
        help="check the installation, or measure where gradients are useful",
        description="Without WHAT, checks the installation: versions, devices, missing "
        "packages, and a few steps of an ant.",
    )
    doctor.add_argument("--json", action="store_true", help="print JSON (without WHAT)")
    doctor.set_defaults(run=health.run, modules=[])
    ailments = doctor.add_subparsers(dest="ailment", metavar="WHAT")
    parser = ailments.add_parser(
        "gradients",
        help="measure over how many control steps a gradient is useful, and why",
        description="Compares the gradient of the return with central differences "
        "and with an evolution strategy, horizon by horizon.",
    )
    modules.add_argument(parser)
    parser.set_defaults(run=run)
    parser.add_argument(
        "env_name", metavar="ENV", help="environment, for example ant_uni"
    )
    parser.add_argument(
        "--horizons",
        type=widths,
        default=(1, 2, 4, 8, 16, 32, 64),
        metavar="N,N",
        help="horizons in control steps (default: 1,2,4,8,16,32,64)",
    )
    for name, default, text in (
        ("worlds", 8, "number of random action sequences"),
        ("directions", 8, "directions of central differences in each world"),
        ("samples", 16, "pairs of noisy samples in each world"),
        ("seed", 0, "seed of all random numbers"),
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


def run(arguments: argparse.Namespace) -> int:
    """Prints a report, and writes it to files with ``--out``. Returns the exit code.

    Raises:
        ConfigError: The folder for the files cannot be written.
    """
    import newton_qd

    if arguments.json:
        refused = "--json: got it with gradients; allowed: without WHAT"
        return complain(arguments, refused, BAD_ARGUMENTS)
    out = arguments.out
    if out is not None and out.exists() and not out.is_dir():  # not after minutes
        refused = f"--out: got {out}, a file; allowed: a folder, or a new name"
        return complain(arguments, refused, BAD_ARGUMENTS)
    if out is not None:
        require_writable("--out", out)
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
    except (TypeError, ValueError) as error:
        return complain(arguments, error, BAD_ARGUMENTS)
    table, _, verdict = str(report).rpartition("\n")
    print(table)
    say(verdict)
    if out is not None:
        report.write(out)
        print(f"written to {out}")
    return OK
