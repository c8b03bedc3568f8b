"""Print the error line of a command and choose its exit code."""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from typing import NoReturn


def complain(message: object, code: int) -> int:
    """Write one line to stderr and return the exit code."""
    print(f"csac: {' '.join(str(message).split())}", file=sys.stderr)
    return code


def interrupted(error: KeyboardInterrupt) -> int:
    """Return the exit code for the signal that raised `error`."""
    return 128 + (signal.SIGTERM if signal.SIGTERM in error.args else signal.SIGINT)


def leave(code: int) -> NoReturn:
    """End the process at once: Python's own end crashes while XLA compiles in a thread."""
    with suppress(OSError):
        sys.stdout.flush()
    os._exit(code)
