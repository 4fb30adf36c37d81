"""The documentation that is written from the code."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

DOCS = Path(__file__).resolve().parents[1] / "docs"


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", DOCS / "generate.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_environments_page_is_up_to_date(generate: ModuleType) -> None:
    written = (DOCS / "environments.md").read_text(encoding="utf-8")
    assert written == generate.page(), "run: python docs/generate.py"


def test_algorithms_on_the_evolve_page_are_up_to_date(generate: ModuleType) -> None:
    written = (DOCS / "evolve.md").read_text(encoding="utf-8")
    assert written == generate.evolve_page(), "run: python docs/generate.py"
