"""How everything here is measured: in whole processes that are bound to their processors before they start."""

from __future__ import annotations

import json
import os
import platform
import re
import resource
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import psutil

from benchmarks.operations import DOMINANT, Product
from csac.processes import usable_cores

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

ROOT = Path(__file__).resolve().parents[1]
TASK = "HalfCheetah-v4"
REPORT_STEPS = 250  # csac tells its progress every so many steps
ROLLOUT_STEPS = 2048  # of PPO, whose first update is at this step


class Window(NamedTuple):
    """When steps are counted. All steps are environment steps of one seed."""

    warmup: int = REPORT_STEPS  # the first update is at this step
    settled: int = 500  # the window begins at this one,
    seconds: float = 5.0  # lasts at least so long
    steps: int = 1  # and has at least so many
    evaluation_interval: int = 0  # 0 for no evaluation
    evaluation_episodes: int = 10


class Process(NamedTuple):
    """A process to start, and the processors that it may use."""

    command: Sequence[str]
    cores: Sequence[int]


def worker(module: str, **arguments: Any) -> list[str]:
    """Return the command that calls `measure` of a module of `benchmarks.workers`."""
    call = [sys.executable, "-m", "benchmarks.worker", module, json.dumps(arguments)]
    return ["env", f"PYTHONPATH={ROOT}", *call]


def training(
    algorithm: str,
    window: Window,
    seeds: int = 1,
    interval: int = 1,
    device: str = "cpu",
    task: str = TASK,
    preset: str = "paper",
    groups: int | None = None,
) -> list[str]:
    """Return the command that trains until the window is over; `interval` updates are made in one dispatch.

    The seeds are split over so many processes, `groups`; None for as many as csac chooses.
    """
    return worker(
        "training",
        algorithm=algorithm,
        task=task,
        preset=preset,
        seeds=seeds,
        groups=groups,
        interval=interval,
        device=device,
        launched=time.monotonic(),
        **window._asdict(),
    )


def surroundings(device: str) -> dict[str, str]:
    """Return the environment variables of a process that computes on this device, cpu or gpu."""
    hidden = {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""} if device == "cpu" else {}
    return {**os.environ, **hidden}


def run_one(command: Sequence[str], cores: int | None = None, device: str = "cpu") -> dict[str, Any]:
    """Run one process, by default on all processors, and return what it prints."""
    return run([Process(command, usable_cores()[:cores])], surroundings(device))[0]


def run(processes: Sequence[Process], environment: Mapping[str, str], together: bool = False) -> list[dict[str, Any]]:
    """Run processes side by side in a folder that is removed afterwards, and return the JSON that each prints.

    Args:
        processes: what to run, and where.
        environment: their environment variables.
        together: they print `ready` and wait for each other before their windows begin.

    Raises:
        RuntimeError: one of them ended without an answer; it says what that one printed.
    """
    with ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        errors = stack.enter_context(tempfile.TemporaryFile("w+"))
        # What torch.compile made for another measurement is not found: every start is a cold one.
        environment = {**environment, "TORCHINDUCTOR_CACHE_DIR": folder}
        started = [stack.enter_context(_start(process, environment, folder, errors)) for process in processes]
        try:
            if together:
                _begin_together(started, errors)
            return [json.loads(_line(process, "{", errors)) for process in started]
        except BaseException:
            for process in started:
                process.kill()
            raise


def _start(process: Process, environment: Mapping[str, str], folder: str, errors: IO[str]) -> subprocess.Popen[str]:
    # The cores come first, for XLA and others look only once which they have.
    bound = ["taskset", "--cpu-list", ",".join(map(str, process.cores)), *process.command]
    pipe = subprocess.PIPE
    return subprocess.Popen(bound, stdin=pipe, stdout=pipe, stderr=errors, text=True, cwd=folder, env=environment)


def _begin_together(processes: Sequence[subprocess.Popen[str]], errors: IO[str]) -> None:
    """Let the windows of all processes begin at once, so that each has its neighbour for the whole of its own."""
    for process in processes:
        _line(process, "ready", errors)
    for process in processes:
        assert process.stdin
        process.stdin.write("go\n")
        process.stdin.flush()


def _line(process: subprocess.Popen[str], prefix: str, errors: IO[str]) -> str:
    """Wait for the line that begins with `prefix`; other libraries print as well."""
    assert process.stdout
    for line in process.stdout:
        if line.startswith(prefix):
            return line
    process.wait()
    errors.seek(0)
    raise RuntimeError(f"a measurement failed: {process.args}\n{errors.read()[-3000:]}")


def watch_load() -> Callable[[], float]:
    """Begin to watch; the function returned tells how many processors other programs kept busy since then."""

    def others() -> float:
        """Return the seconds of all processors, the hypervisor's included, but not of this process's children."""
        times, own = psutil.cpu_times(), resource.getrusage(resource.RUSAGE_CHILDREN)
        busy = times.user + times.nice + times.system + times.irq + times.softirq + times.steal
        return busy - own.ru_utime - own.ru_stime

    began, before = time.monotonic(), others()
    return lambda: max(0.0, (others() - before) / (time.monotonic() - began))


def product_rates(size: Product, groups: Sequence[Sequence[int]], seconds: float) -> list[float]:
    """Return operations per second of a product in each of several processes, side by side on these processors."""
    processes = [Process(worker("products", size=size, seconds=seconds), cores) for cores in groups]
    return [answer["rate"] for answer in run(processes, surroundings("cpu"))]


def one_core_rate(seconds: float) -> float:
    """Return 10⁹ operations per second of the dominant product on the first processor."""
    return product_rates(DOMINANT, [usable_cores()[:1]], seconds)[0] / 1e9


def machine(seconds: float) -> list[str]:
    """Return what all numbers depend on, a line each: the machine, how fast it multiplies, and the versions."""
    with open("/proc/cpuinfo") as file:
        models = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    packages = ("jax", "gymnasium", "mujoco", "numpy")
    return [
        f"processor: {models[0] if models else platform.machine()}, {os.cpu_count()} cores, {platform.system()}; "
        f"one core multiplies 256 x 256 x 256 at {one_core_rate(seconds):.0f} x 10⁹ operations/s",
        f"csac {version('csac')} at commit {_commit()}, Python {platform.python_version()}, "
        + ", ".join(f"{name} {version(name)}" for name in packages),
    ]


def lasting(lines: Iterable[str]) -> list[str]:
    """Return the lines of `machine` without what changes on one machine: how fast it multiplied, and the commit."""
    return [re.sub(r"; one core multiplies .*| at commit [^,]*", "", line) for line in lines]


def _commit() -> str:
    git: dict[str, Any] = {"cwd": ROOT, "capture_output": True, "text": True, "check": True}
    try:
        commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], **git).stdout.strip()
        changed = subprocess.run(["git", "status", "--porcelain", "csac"], **git).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{commit} with changes" if changed else commit
