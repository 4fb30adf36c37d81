"""``python -m newton_qd`` is the command ``newton-qd``."""

import sys

from newton_qd.cli import main

if __name__ == "__main__":
    sys.exit(main())
