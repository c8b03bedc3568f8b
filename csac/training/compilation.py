"""Keep compiled programs from one run to the next, in JAX's persistent compilation cache.

JAX's cache key covers the processor features that a program may use, but not the number of threads it was divided for,
and machines may share a folder: so each kind of processor and each number of cores has its own folder.
"""

from __future__ import annotations

import hashlib
import os
import platform
import tempfile
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import jax

from csac.training.devices import threads_in_use

MOST_BYTES = 256 * 2**20  # for all programs; those of one algorithm, task and preset take half a MiB
SECONDS_WORTH_KEEPING = 0.1  # of compile time; loading takes a tenth of it or less

_PROCESSOR = (  # the fields of /proc/cpuinfo that determine what XLA compiles for
    *("vendor_id", "cpu family", "model", "model name", "stepping", "flags"),
    *("CPU implementer", "CPU architecture", "CPU variant", "CPU part", "Features"),
)


def keep_programs() -> None:
    """Have JAX load programs from the cache in this process from now on, and store those that it has to compile.

    Does nothing if the user has configured the cache (`JAX_COMPILATION_CACHE_DIR`, `JAX_ENABLE_COMPILATION_CACHE=0`, or
    the same in `jax.config`), or if the folder cannot be written.
    """
    with suppress(OSError):
        if not _is_users_choice():
            folder = _make_home() / f"{_processor()}-{threads_in_use()}"
            jax.config.update("jax_compilation_cache_dir", str(folder))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", SECONDS_WORTH_KEEPING)


def tidy_programs() -> list[str]:
    """Remove broken programs before a run, or all if they are too large; return a note if none can be kept."""
    if _is_users_choice():
        return []
    try:
        home = _make_home()
        programs = list(home.glob("*/*-cache"))
        with suppress(FileNotFoundError):  # another process may remove them too
            _remove_broken(home / "checked", programs)
            if sum(program.stat().st_size for program in programs) > MOST_BYTES:
                for program in programs:
                    program.unlink(missing_ok=True)
    except OSError as error:
        return [f"note: compiled programs cannot be kept for the next run ({error})"]
    return []


def _remove_broken(mark: Path, programs: list[Path]) -> None:
    """Remove programs written since the last check that a killed process left incomplete: JAX never replaces them."""
    since = mark.stat().st_mtime if mark.exists() else 0.0
    mark.touch()
    for program in programs.copy():
        if program.stat().st_mtime >= since and not _is_whole(program.read_bytes()):
            program.unlink(missing_ok=True)
            programs.remove(program)


def _is_whole(program: bytes) -> bool:
    """Return whether a program can be unpacked if JAX packed it with zlib; with zstd, whether it is not empty."""
    try:
        return bool(zlib.decompress(program) if program[:1] == b"\x78" else program)
    except zlib.error:
        return False


def _is_users_choice() -> bool:
    config: Any = jax.config
    folder = config.jax_compilation_cache_dir
    return not config.jax_enable_compilation_cache or (folder is not None and Path(folder).parent != _home())


def _home() -> Path:
    base = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(base) if os.path.isabs(base) else Path(os.path.expanduser("~/.cache"))) / "csac" / "programs"


def _make_home() -> Path:
    """Return the folder of all programs. Raises OSError if it cannot be written."""
    home = _home()
    if not home.is_absolute():
        raise FileNotFoundError("there is no home directory")
    home.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=home):
        return home


def _processor() -> str:
    """Return an identifier of the processor that XLA compiles for; without /proc/cpuinfo, of this machine."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    facts = sorted({line for line in lines if line.partition(":")[0].strip() in _PROCESSOR}) or [platform.node()]
    return hashlib.sha256("\n".join([platform.system(), platform.machine(), *facts]).encode()).hexdigest()[:12]
