"""What the site has beside the files of this folder.

MkDocs calls these functions while it builds the site. The pages on contributing and on
changes are files of the repository, and the notebooks become pages.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
RESULTS = "benchmarks/results/"
NOTEBOOKS = ROOT / "docs" / "notebooks"


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds pages that are made from other files."""
    for name in ("CONTRIBUTING", "CHANGELOG"):
        text = (ROOT / f"{name}.md").read_text(encoding="utf-8")
        files.append(File.generated(config, f"{name.lower()}.md", content=inside(text)))
    for path in sorted(NOTEBOOKS.glob("*.ipynb")):
        page = f"notebooks/{path.stem}.md"
        files.append(File.generated(config, page, content=notebook_page(path)))
    for path in sorted(ROOT.glob(f"{RESULTS}*.csv")):
        table = f"results/{path.name}"
        files.append(File.generated(config, table, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, **kwargs: object) -> str:
    """Leads links to where the site has their files.

    A link to a notebook leads to its page, except the one that downloads it.
    """
    markdown = markdown.replace(f"](../{RESULTS}", "](results/")
    return re.sub(r"(?<!notebook\])\(([\w/]+)\.ipynb\)", r"(\1.md)", markdown)


def inside(text: str) -> str:
    """Returns a text of the root as a page: links into this folder lose its name."""
    return re.sub(r"\]\(docs/", "](", text)


def notebook_page(path: Path) -> str:
    """Returns the page of a notebook: its texts, its code and what the code prints."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    parts = []
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        parts += [shown(output) for output in cell["outputs"]]
    head, *rest = parts
    note = f"[Download this notebook]({path.name}) (`{path.relative_to(ROOT)}`)."
    return "\n\n".join([head, note, *rest, ""])


def shown(output: dict[str, Any]) -> str:
    """Returns an output of a cell as Markdown."""
    data = output.get("data", {})
    if "image/png" in data:
        image = "".join(data["image/png"]).replace("\n", "")
        return f"![What the cell draws](data:image/png;base64,{image})"
    text = "".join(output.get("text", data.get("text/plain", "")))
    return f"```text\n{text.rstrip()}\n```"
