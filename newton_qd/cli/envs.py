"""``newton-qd envs``: prints a table of the registered environments."""

from __future__ import annotations

import argparse
from typing import Any

from newton_qd.cli import modules
from newton_qd.cli.arguments import OK, Commands


def add_parser(commands: Commands) -> None:
    """Adds the command to the subparsers of ``newton-qd``."""
    parser = commands.add_parser("envs", help="list the environments")
    modules.add_argument(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Prints the table and returns the exit code."""
    del arguments
    import newton_qd
    from newton_qd.physics.precision import quiet

    quiet()
    rows = [("name", "observation", "action", "descriptor", "reward offset")]
    for name in newton_qd.registered_envs():
        env: Any = newton_qd.create(name)
        descriptor = offset = "-"
        if name in newton_qd.tables.descriptor_extractor:
            descriptor = f"{env.state_descriptor_name} ({env.descriptor_length})"
            offset = f"{newton_qd.tables.reward_offset[name]:g}"
        sizes = str(env.observation_size), str(env.action_size)
        rows.append((name, *sizes, descriptor, offset))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        print("  ".join(cells).rstrip())
    return OK
