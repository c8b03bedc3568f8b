"""Where a run is made, for its manifest: the machine, the package versions and csac's own commit."""

from __future__ import annotations

import os
import platform
import subprocess
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, distributions, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from csac import __version__
from csac.record.manifest import Machine
from csac.tasks.registry import adapter_of
from csac.training.devices import in_use

if TYPE_CHECKING:
    from csac.tasks.registry import Task


def provenance(task: Task, command: str | None, threads: int) -> dict[str, Any]:
    """Return these fields of a manifest for this process, whose device must have been chosen."""
    machine = Machine(_processor(), threads, platform.node(), **in_use())
    return {
        "machine": machine,
        "versions": _versions(task, on_gpu=bool(machine.gpu)),
        "commit": _commit(),
        "command": command,
        "process": os.getpid(),
    }


def _versions(task: Task, on_gpu: bool) -> dict[str, str]:
    """Return the versions of the packages that affect the numbers; on a GPU also those of all its libraries."""
    robots = ("pybullet", "PyFlyt", "panda-gym") if adapter_of(task) else ()
    versions = {"csac": __version__, "python": platform.python_version()}
    for package in ("jax", "jaxlib", "equinox", "optax", "numpy", "gymnasium", "mujoco", *robots):
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    if on_gpu:
        names = filter(None, (distribution.name for distribution in distributions()))  # None: a broken installation
        versions |= {name: version(name) for name in sorted(names) if name.startswith(("jax-cuda", "nvidia-"))}
    return versions


def _processor() -> str:
    """Return the processor's model, as far as the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()


def _commit() -> str | None:
    """Return the commit of csac's own checkout, if it runs from one."""
    with suppress(OSError, subprocess.SubprocessError):
        # csac may be installed inside somebody else's repository, which does not track its files.
        _git("ls-files", "--error-unmatch", Path(__file__).name)
        return _git("rev-parse", "HEAD").strip() or None
    return None


def _git(*arguments: str) -> str:
    """Return the output of git in the folder of this file. Raises OSError or SubprocessError."""
    command = ["git", "-C", Path(__file__).parent, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout
