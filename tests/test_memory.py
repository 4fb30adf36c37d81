"""The memory of this machine, and the refusal of what does not fit."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from newton_qd import memory


def test_the_container_may_have_less_than_the_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    file = tmp_path / "memory.max"
    monkeypatch.setattr(memory, "_CONTAINER", (tmp_path / "absent", file))
    for text, expected in (
        (f"{machine // 2}\n", machine // 2),
        (f"{2 * machine}\n", machine),
        ("max\n", machine),
    ):
        file.write_text(text, encoding="ascii")
        assert memory.limit() == expected


def test_a_device_says_what_it_has() -> None:
    class Device:
        platform = "gpu"

        def memory_stats(self) -> dict[str, int] | None:
            return {"bytes_limit": 7}

    assert memory.limit(Device()) == 7


@pytest.mark.parametrize(
    ("needed", "text"),
    [
        (1_001, "at least 1 kB"),
        (2_500_000, r"at least 2\.5 MB"),
        (5_000_000_000_000_000, "at least 5,000 TB"),
    ],
)
def test_sizes_are_told_in_units(needed: int, text: str) -> None:
    with pytest.raises(ValueError, match=f"^size: got 3, which needs {text}; allowed"):
        memory.check("size", 3, needed, 1_000)


def test_what_fits_exactly_is_allowed() -> None:
    memory.check("size", 3, 1_000, 1_000)
    memory.check("size", 3, 1_000, None)
