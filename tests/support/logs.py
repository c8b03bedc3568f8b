"""What a run's log says, but for when it was said."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

TIME = re.compile(rb"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d\d:\d\d ", re.MULTILINE)


def without_times(content: bytes) -> bytes:
    """Return a log as every run has it that does the same."""
    return TIME.sub(b"", content)


def log_lines(run: Path) -> list[str]:
    """Return the lines of a run's log without their times."""
    return without_times((run / "log.txt").read_bytes()).decode().splitlines()
