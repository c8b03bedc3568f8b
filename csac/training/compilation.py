"""Keep compiled programs from one run to the next, in JAX's persistent compilation cache.

JAX's cache key covers the processor features that a program may use, but not the number of threads it was divided for,
and machines may share a folder: so each kind of processor and each number of cores has its own folder.
"""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax

from csac.training.devices import threads_in_use

MOST_BYTES = 256 * 2**20  # for all programs; those of one algorithm, task and preset take half a MiB
_PROCESSOR = (
    "vendor_id",
    "cpu family",
    "model",
    "stepping",
    "flags",
    "CPU ",
    "Features",
)  # of /proc/cpuinfo, x86 and ARM
SECONDS_WORTH_KEEPING = 0.1  # of compile time; loading takes a tenth of it or less


def keep_programs() -> None:
    """Have JAX load programs from the cache in this process from now on, and store those that it has to compile.

    Does nothing if the user has configured the cache (`JAX_COMPILATION_CACHE_DIR`, `JAX_ENABLE_COMPILATION_CACHE=0`, or
    the same in `jax.config`), or if the folder cannot be written.
    """
    if _is_users_choice():
        return
    folder = _home() / f"{_processor()}-{threads_in_use()}"
    with suppress(OSError):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()  # raises if the folder cannot be written
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", SECONDS_WORTH_KEEPING)


def tidy_programs() -> None:
    """Remove all programs before a run if they are too large."""
    if _is_users_choice():
        return
    with suppress(OSError):  # such as a file that another process has removed
        programs = list(_home().glob("*/*-cache"))
        if sum(program.stat().st_size for program in programs) > MOST_BYTES:
            for program in programs:
                program.unlink(missing_ok=True)


def _is_users_choice() -> bool:
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    return not config.jax_enable_compilation_cache or (folder is not None and Path(folder).parent != _home())


def _processor() -> str:
    """Return an identifier of the processor that XLA compiles for; without /proc/cpuinfo, of this machine."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = [platform.node()]
    facts = sorted({line for line in lines if line.startswith(_PROCESSOR)}) or lines
    return hashlib.sha256("\n".join([platform.machine(), *facts]).encode()).hexdigest()[:12]


def _home() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")) / "csac" / "programs"
