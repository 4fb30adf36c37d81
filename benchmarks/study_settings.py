"""Write the settings of the study into the package, for ``newton-qd evolve --study``.

python benchmarks/study_settings.py            writes newton_qd/qd/study.toml
python benchmarks/study_settings.py --check    fails if it is out of date

They are those of the protocol ``field`` and of the variants that ``field.toml``
chooses, for each algorithm that has a run with its variant after 60 s.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from study_protocols import PROTOCOLS
from study_runs import TUNING_SEED, chosen, lines, variants

BENCHMARKS = Path(__file__).resolve().parent
FILE = BENCHMARKS.parent / "newton_qd" / "qd" / "study.toml"
FIELD = BENCHMARKS / "results" / "field"
STOP = "60 s"
HEAD = """# Settings of the study (docs/study.md), by environment and algorithm.
# benchmarks/study_settings.py writes this file.
"""


def _text(value: Any) -> str:
    """Returns a value in TOML."""
    if isinstance(value, dict):
        return f"{{ {', '.join(f'{k} = {_text(x)}' for k, x in value.items())} }}"
    return json.dumps(value)


def document() -> str:
    """Returns the text of the file."""
    ran = {
        (line["task"], line["variant"])
        for line in lines(FIELD)
        if line["stop"] == STOP and int(line["seed"]) < TUNING_SEED
    }
    protocol, settings, parts = PROTOCOLS["field"], variants(), [HEAD]
    for task in protocol.tasks:
        for algorithm in protocol.algorithms:
            variant = chosen(algorithm, task)
            if (task, variant) in ran:
                own = dict(sorted(settings[variant].items()))
                given = {**protocol.settings_of(task), **own}
                rows = [f"{name} = {_text(value)}" for name, value in given.items()]
                parts.append("\n".join([f"[{task}.{algorithm}]", *rows, ""]))
    return "\n".join(parts)


def main() -> int:
    """Writes the file, or compares it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    new = document()
    old = FILE.read_text(encoding="utf-8") if FILE.is_file() else ""
    if new == old:
        return 0
    print(f"{FILE.name}: {'out of date' if check else 'written'}")
    if not check:
        FILE.write_text(new, encoding="utf-8")
    return int(check)


if __name__ == "__main__":
    sys.exit(main())
