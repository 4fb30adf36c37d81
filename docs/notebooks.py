"""Run the notebooks of this folder, without Jupyter.

python docs/notebooks.py          runs every notebook in a new folder, and saves what
                                  its cells print and draw
python docs/notebooks.py NAME     runs docs/notebooks/NAME.ipynb alone

Values and pages for a browser are not saved, because pages are large.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

FOLDER = Path(__file__).with_name("notebooks")
DPI = 60  # of figures: a notebook stays small


def run(path: Path) -> Iterator[tuple[dict[str, Any], list[dict[str, Any]]]]:
    """Runs the cells of a notebook in the current folder, in their order.

    Args:
        path: The notebook.

    Yields:
        A cell with code, and its outputs.
    """
    module = ModuleType(path.stem)  # dataclasses look their module up
    sys.modules[module.__name__] = module
    try:
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                code = "".join(cell["source"])
                yield cell, run_cell(code, vars(module), path.name)
    finally:
        del sys.modules[module.__name__]


def run_cell(code: str, names: dict[str, Any], title: str) -> list[dict[str, Any]]:
    """Runs one cell and returns its outputs, as a notebook stores them."""
    tree = ast.parse(code, title)
    last = tree.body[-1]
    value, printed = None, io.StringIO()
    with contextlib.redirect_stdout(printed):
        if isinstance(last, ast.Expr):
            tree.body.pop()
            exec(compile(tree, title, "exec"), names)
            value = eval(compile(ast.Expression(last.value), title, "eval"), names)
        else:
            exec(compile(tree, title, "exec"), names)
    outputs: list[dict[str, Any]] = []
    if printed.getvalue():
        text = printed.getvalue().splitlines(keepends=True)
        outputs.append({"output_type": "stream", "name": "stdout", "text": text})
    # Jupyter shows other figures only after pyplot was used
    if hasattr(value, "_repr_png_") or ("plt" in names and hasattr(value, "savefig")):
        outputs.append({"output_type": "display_data", "metadata": {}, "data": {}})
        outputs[-1]["data"]["image/png"] = picture(value)
    return outputs


def picture(figure: Any) -> str:
    """Returns a figure as the text of a PNG."""
    content = io.BytesIO()
    figure.savefig(content, dpi=DPI, bbox_inches="tight")
    return base64.b64encode(content.getvalue()).decode()


def save(path: Path) -> None:
    """Runs a notebook in a new folder and writes its outputs into it."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    home = os.getcwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        try:
            outputs = [outputs for _, outputs in run(path)]
        finally:
            os.chdir(home)
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for number, (cell, found) in enumerate(zip(cells, outputs, strict=True), 1):
        cell.update(execution_count=number, outputs=found)
    text = json.dumps(notebook, indent=1, ensure_ascii=False)
    path.write_text(f"{text}\n", encoding="utf-8")


def main() -> None:
    """Runs the notebooks that the arguments name, or all of them."""
    names = sys.argv[1:] or [path.stem for path in sorted(FOLDER.glob("*.ipynb"))]
    for name in names:
        path = FOLDER.resolve() / f"{name}.ipynb"
        save(path)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
