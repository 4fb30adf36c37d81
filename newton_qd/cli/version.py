"""``newton-qd --version``."""

from __future__ import annotations

import argparse
import platform
import sys
from typing import Any

from newton_qd.qd.facts import package_versions


class ShowVersion(argparse.Action):
    """Prints the versions of the package and of what results depend on."""

    def __init__(self, option_strings: list[str], dest: str, **options: Any) -> None:
        super().__init__(option_strings, dest, nargs=0, **options)

    def __call__(
        self, parser: argparse.ArgumentParser, *arguments: Any, **options: Any
    ) -> None:
        """Prints the versions and exits."""
        del arguments, options
        import newton_qd

        print(f"newton_qd {newton_qd.__version__}")
        print(f"python {platform.python_version()}")
        for name, version in package_versions().items():
            if name != "newton_qd":
                print(f"{name} {version or 'is not installed'}")
        sys.stdout.flush()  # an error of the output is not an error at the exit
        parser.exit()
