"""Measurements in separate processes, which are bound to their cores before they start."""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import psutil

from benchmarks import stamps
from benchmarks.products import DOMINANT, Product

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

ROOT = Path(__file__).resolve().parents[1]
TASK = stamps.BASE
NEVER = 1_000_000  # steps of a run that is stopped long before its end; they determine the replay size
ROLLOUT_STEPS = 2048  # of PPO; its first update is at this step


class Launch(NamedTuple):
    """A command and the cores it may use."""

    command: Sequence[str]
    cores: Sequence[int]


class Window(NamedTuple):
    """When steps are counted. All steps are environment steps of one seed."""

    seconds: float = 5.0  # minimum length of the window
    warmup: int = 250  # the first update is at this step
    settled: int = 500  # the window begins when every seed has made this many steps
    every: int = 50  # steps between two time stamps


def usable_cores() -> list[int]:
    """Return the cores that this process may use."""
    return sorted(os.sched_getaffinity(0))


def surroundings(device: str = "cpu", **variables: str) -> dict[str, str]:
    """Return the environment variables of a process that computes on `cpu` or `gpu`."""
    hidden = {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""} if device == "cpu" else {}
    return {**os.environ, **hidden, "PYTHONPATH": str(ROOT), **variables}


class ProcessFailure(RuntimeError):
    """A measured process ended without an answer; the message contains its output."""


@contextmanager
def started(launches: Sequence[Launch], environment: dict[str, str]) -> Iterator[tuple[Path, list[subprocess.Popen]]]:
    """Start commands in parallel in a temporary folder; at the end kill each with all its child processes."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder, processes = Path(name), []
        errors = stack.enter_context((folder / "errors").open("w"))
        for number, (command, cores) in enumerate(launches):
            output = stack.enter_context((folder / f"output-{number}").open("w"))
            bound = ["taskset", "--cpu-list", ",".join(map(str, cores)), *command]  # first: XLA detects cores once
            options: dict[str, Any] = {"cwd": folder, "env": environment, "process_group": 0}
            processes.append(subprocess.Popen(bound, stdout=output, stderr=errors, **options))
            stack.callback(_kill, processes[-1])
        yield folder, processes


def _kill(process: subprocess.Popen) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def failure(folder: Path, process: subprocess.Popen) -> ProcessFailure:
    """Return an error with the output of a process of `started`."""
    return ProcessFailure(f"{process.args} failed\n{(folder / 'errors').read_text()[-3000:]}")


# A function of this package, or a script that prints JSON.


def answers(launches: Sequence[Launch], device: str = "cpu") -> list[dict[str, Any]]:
    """Run commands in parallel, and return the last line that each prints, parsed as JSON.

    Raises:
        ProcessFailure: a command failed.
    """
    with started(launches, surroundings(device)) as (folder, processes):
        for process in processes:
            if process.wait():
                raise failure(folder, process)
        outputs = (folder / f"output-{number}" for number in range(len(processes)))
        return [json.loads(output.read_text().splitlines()[-1]) for output in outputs]


def call(function: str, cores: int | None = None, device: str = "cpu", **arguments: Any) -> dict[str, Any]:
    """Call a `module:function` of this package in a separate process, by default on all cores."""
    return answers([Launch(call_command(function, **arguments), usable_cores()[:cores])], device)[0]


def call_command(function: str, **arguments: Any) -> list[str]:
    """Return the command that calls a `module:function` of this package and prints its result."""
    return [sys.executable, "-m", "benchmarks.call", function, json.dumps(arguments)]


def time_command(command: Sequence[str], code: int = 0, **variables: str) -> float:
    """Return the seconds from launch to exit with `code`, on all cores. Raises ProcessFailure like `answers`."""
    began = time.monotonic()
    with started([Launch(command, usable_cores())], surroundings(**variables)) as (folder, (process,)):
        if process.wait() != code:
            raise failure(folder, process)
        return time.monotonic() - began


# Training, timed by the stamps of its task.


def csac_command(
    algorithm: str,
    *options: str,
    preset: str = "paper",
    seeds: int = 1,
    device: str = "cpu",
    task: str = stamps.TASK,
) -> list[str]:
    """Return a `csac train` command with a preset, without evaluation and with a short warm-up."""
    given = {"algorithm": algorithm, "preset": preset, "seeds": seeds, "device": device, "directory": "run"}
    given |= {"steps": NEVER, "evaluation-interval": NEVER} | ({} if algorithm == "ppo" else {"warmup-steps": 250})
    words = [word for name, value in given.items() for word in (f"--{name}", str(value))]
    return [sys.executable, "-m", "csac", "train", task, *words, *options]


def time_training(
    launches: Sequence[Launch], window: Window, seeds: int = 1, device: str = "cpu", **variables: str
) -> dict[str, float]:
    """Run these training commands in parallel until the window is over, and return the measurements.

    `steps_per_second`, `steps` and `cpu_seconds` are totals over all seeds and processes in the window; `start_seconds`
    is the time from launch to the first update of every seed; `peak_mib` is the resident memory of all processes, with
    shared memory counted for each; `other_load` is the number of cores kept busy by other programs, including the
    hypervisor.

    Raises:
        ProcessFailure: a command ended before the window.
    """
    with tempfile.TemporaryDirectory() as written:
        told = {stamps.FOLDER: written, stamps.EVERY: str(window.every), "XDG_STATE_HOME": written, **variables}
        launched, busy = time.monotonic(), busy_seconds()
        with started(launches, surroundings(device, **told)) as (folder, processes):
            used = [(launched, 0.0)]  # time, and CPU seconds until then
            while (speed := speed_of(read_stamps(Path(written)), window, seeds, launched)) is None:
                if ended := [process for process in processes if process.poll() is not None]:
                    raise failure(folder, ended[0])
                if time.monotonic() - used[-1][0] > 1.0:  # rarely: this takes a hundredth of a second
                    used.append((time.monotonic(), sum(map(_cpu_seconds, _families(processes)))))
                time.sleep(0.2)
            family = _families(processes)
            used.append((time.monotonic(), sum(map(_cpu_seconds, family))))
            end = min(stamp[-1, 1] for stamp in read_stamps(Path(written)) if stamp[-1, 0] > window.settled)
            times, seconds = zip(*used, strict=True)
            begin_and_end = np.interp([end - speed["seconds"], end], times, seconds)
            speed["cpu_seconds"] = float(np.diff(begin_and_end)[0])
            others = busy_seconds() - busy - used[-1][1]
            load = max(0.0, others / (time.monotonic() - launched))
            own = {path.name.partition("-")[0] for path in Path(written).glob("*-*")}
            return {**speed, "processes": len(own), "peak_mib": sum(map(_peak_mib, family)), "other_load": load}


def read_stamps(folder: Path) -> list[np.ndarray]:
    """Return the time stamps [stamp, (steps, seconds)] of each environment that has written any."""
    texts = (path.read_text() for path in sorted(folder.glob("*-*")))
    whole = (text[: text.rfind("\n") + 1] for text in texts)  # the last line may be incomplete
    return [np.loadtxt(text.splitlines(), ndmin=2) for text in whole if text]


def speed_of(written: list[np.ndarray], window: Window, seeds: int, launched: float) -> dict[str, float] | None:
    """Return the speed in the window, or None if it is not over; steps between two stamps are interpolated."""
    own = [stamp for stamp in written if stamp[-1, 0] > window.settled]
    if len(own) < seeds:
        return None
    begin = max(stamp[np.searchsorted(stamp[:, 0], window.settled), 1] for stamp in own)
    end = min(stamp[-1, 1] for stamp in own)
    if end - begin < window.seconds:
        return None
    steps = sum(float(np.diff(np.interp([begin, end], stamp[:, 1], stamp[:, 0]))[0]) for stamp in own)
    first = max(stamp[np.searchsorted(stamp[:, 0], window.warmup), 1] for stamp in own)
    speed = {"steps_per_second": steps / (end - begin), "steps": steps, "seconds": end - begin}
    return {**speed, "start_seconds": first - launched}


def busy_seconds() -> float:
    """Return the busy seconds of all cores of the machine, including time stolen by the hypervisor."""
    times = psutil.cpu_times()
    return times.user + times.nice + times.system + times.irq + times.softirq + times.steal


def _families(processes: Sequence[subprocess.Popen]) -> list[psutil.Process]:
    parents = [psutil.Process(process.pid) for process in processes]
    return [member for parent in parents for member in (parent, *parent.children(recursive=True))]


def _cpu_seconds(process: psutil.Process) -> float:
    with suppress(psutil.NoSuchProcess):
        times = process.cpu_times()
        return times.user + times.system + times.children_user + times.children_system
    return 0.0


def _peak_mib(process: psutil.Process) -> float:
    with suppress(OSError, StopIteration), open(f"/proc/{process.pid}/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmHWM:")) / 1024
    return 0.0


# The machine.


def product_rates(product: Product, groups: Sequence[Sequence[int]], seconds: float) -> list[float]:
    """Return operations per second of a product in parallel processes, one for each group of cores."""
    command = call_command("benchmarks.products:measure", size=product, seconds=seconds)
    return [answer["rate"] for answer in answers([Launch(command, cores) for cores in groups])]


def one_core_rate(seconds: float) -> float:
    """Return 10⁹ operations per second of the dominant product on the first core."""
    return product_rates(DOMINANT, [usable_cores()[:1]], seconds)[0] / 1e9


def machine(seconds: float) -> list[str]:
    """Return what all results depend on, one line each: the machine with its arithmetic rate, and the versions."""
    with open("/proc/cpuinfo") as file:
        models = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    packages = ", ".join(f"{name} {version(name)}" for name in ("jax", "gymnasium", "mujoco", "numpy"))
    return [
        f"processor: {models[0] if models else platform.machine()}, {os.cpu_count()} cores, {platform.system()}; "
        f"one core multiplies 256 x 256 x 256 at {one_core_rate(seconds):.0f} x 10⁹ operations/s",
        f"csac {version('csac')} at commit {_commit()}, Python {platform.python_version()}, {packages}",
    ]


def _commit() -> str:
    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    with suppress(OSError, subprocess.CalledProcessError):
        return git("rev-parse", "--short", "HEAD") + (" with changes" if git("status", "--porcelain", "csac") else "")
    return "unknown"
