"""Measure csac against its peers: environment steps, each with its update, per second.

    make bench                       # everything; writes the table of README.md
    make bench ARGS=--quick          # does it run? Its numbers mean nothing and are only printed

Every measurement is a process of its own, bound to its processors. README.md says how it is done and what was found.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

from cases import CASES, HERE, LIBRARIES, PARL_PYTHON, PEERS_PYTHON, REACHES, Case
from report import Measurement, markdown, write_between_markers, write_csv

if TYPE_CHECKING:
    from collections.abc import Sequence

TASK = "HalfCheetah-v4"
ROLLOUT_STEPS = 2048  # of PPO: its first update is at this step


class Protocol(NamedTuple):
    """How long a measurement lasts. Steps are environment steps of one seed."""

    repetitions: int = 3
    warmup: int = 250  # csac reports its progress every 250 steps, and its first update is at this one
    settled: int = 500
    seconds: float = 5.0
    seconds_of_five: float = 10.0
    evaluation_interval: int = 5_000
    evaluation_episodes: int = 10


QUICK = Protocol(1, settled=260, seconds=1.0, seconds_of_five=2.0, evaluation_interval=250, evaluation_episodes=1)


def measure(case: Case, repetition: int, protocol: Protocol) -> Measurement:
    """Run one case to its end."""
    cores = sorted(os.sched_getaffinity(0))[: case.cores]
    shares = [cores[i :: case.together] for i in range(case.together)]
    began, busy, own = time.monotonic(), _busy_seconds(), _own_seconds()
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as errors:
        processes = [_launch(case, protocol, share, folder, errors) for share in shares]
        try:
            if case.together > 1:
                _start_together(processes, errors)
            results = [json.loads(_line(process, "{", errors)) for process in processes]
        finally:
            for process in processes:
                process.kill() if sys.exc_info()[0] else process.wait()
    others = (_busy_seconds() - busy) - (_own_seconds() - own)
    return Measurement(
        repetition=repetition,
        setting=case.setting,
        contender=case.contender,
        allowed=case.allowed,
        steps_per_second=sum(result["steps_per_second"] for result in results),
        steps=sum(result["steps"] for result in results),
        seconds=max(result["seconds"] for result in results),
        start_seconds=max(result["start_seconds"] for result in results),
        peak_mib=sum(result["peak_mib"] for result in results),
        other_load=max(0.0, others / (time.monotonic() - began)),
    )


def command(case: Case, protocol: Protocol, cores: Sequence[int]) -> list[str]:
    """Return how one process of the case is started, bound to these cores."""
    library = LIBRARIES[case.library]
    arguments = {
        "algorithm": case.algorithm,
        "task": TASK,
        "seeds": case.seeds,
        "launched": time.monotonic(),
        "warmup": ROLLOUT_STEPS if case.algorithm == "ppo" else protocol.warmup,
        "settled": ROLLOUT_STEPS if case.algorithm == "ppo" else protocol.settled,
        "seconds": protocol.seconds_of_five if case.seeds > 1 else 0.0 if case.evaluated else protocol.seconds,
        "steps": protocol.evaluation_interval if case.evaluated else 1,
        "evaluation-interval": protocol.evaluation_interval if case.evaluated else 0,
        "evaluation-episodes": protocol.evaluation_episodes,
    }
    if library.has_threads:
        arguments["threads"] = case.threads_each
    if case.library == "csac":
        arguments |= {"interval": case.interval, "device": case.device}
    # The cores come first, for XLA and others look only once which they have.
    bound = ["taskset", "--cpu-list", ",".join(map(str, cores)), library.python, str(HERE / library.script)]
    options = [f"--{name}={value}" for name, value in arguments.items()]
    return [*bound, *options, *library.options, *["--together"] * (case.together > 1)]


def _launch(case: Case, protocol: Protocol, cores: Sequence[int], folder: str, errors: IO[str]) -> subprocess.Popen:
    # What torch.compile made for another measurement is not found: every start is a cold one.
    environment = {"TORCHINDUCTOR_CACHE_DIR": folder}
    if case.device == "cpu":
        environment |= {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
    return subprocess.Popen(
        command(case, protocol, cores),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=errors,
        text=True,
        cwd=folder,
        env={**os.environ, **environment},
    )


def _start_together(processes: Sequence[subprocess.Popen[str]], errors: IO[str]) -> None:
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
    raise SystemExit(f"a measurement failed: {' '.join(map(str, process.args))}\n{errors.read()[-3000:]}")  # pyright: ignore


def _busy_seconds() -> float:
    """Return for how long the machine's processors have been busy, or taken by its hypervisor."""
    with open("/proc/stat") as file:
        user, nice, system, _, _, interrupt, soft_interrupt, steal, *_ = map(int, file.readline().split()[1:])
    return (user + nice + system + interrupt + soft_interrupt + steal) / os.sysconf("SC_CLK_TCK")


def _own_seconds() -> float:
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def describe_machine(measurements: Sequence[Measurement], protocol: Protocol) -> list[str]:
    """Return what the numbers depend on, one line each."""
    loads = [m.other_load for m in measurements]
    packages = ("jax", "gymnasium", "mujoco", "numpy")
    peers = ("stable_baselines3", "tianshou", "torch", "sbx-rl", "jax", "gymnasium", "mujoco", "numpy")
    parl = ("parl", "paddlepaddle", "gymnasium", "mujoco", "numpy")
    return [
        describe_processor(),
        f"csac {version('csac')} at commit {_commit()}, Python {platform.python_version()}, "
        + ", ".join(f"{name} {version(name)}" for name in packages),
        f"peers: {_versions(PEERS_PYTHON, peers)}",
        *([f"PARL apart from them: {_versions(PARL_PYTHON, parl)}"] if not LIBRARIES["parl"].lacks() else []),
        *(f"not measured: {line}" for line in lacking()),
        f"one-seed windows of {protocol.seconds:g} s and more, five-seed windows of {protocol.seconds_of_five:g} s; "
        f"repetitions: {protocol.repetitions} of the settings with a range, 1 of the others",
        f"other programs kept {sum(loads) / len(loads):.2f} cores busy on average, {max(loads):.2f} at most"
        + (": **not a quiet machine**" if max(loads) > 0.2 else ""),
    ]


def describe_processor() -> str:
    """Return what the machine is, in words."""
    with open("/proc/cpuinfo") as file:
        models = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    return f"processor: {models[0] if models else platform.machine()}, {os.cpu_count()} cores, {platform.system()}"


def _versions(python: str, packages: Sequence[str]) -> str:
    code = "import sys, importlib.metadata as m; print(', '.join(f'{n} {m.version(n)}' for n in sys.argv[1:]))"
    result = subprocess.run([python, "-c", code, *packages], capture_output=True, text=True, check=True)
    return result.stdout.strip()


def _commit() -> str:
    try:
        git: dict[str, Any] = {"cwd": HERE, "capture_output": True, "text": True, "check": True}
        commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], **git).stdout.strip()
        changed = subprocess.run(["git", "status", "--porcelain", "../csac"], **git).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return f"{commit} with changes" if changed else commit


def lacking() -> list[str]:
    """Return a line for each contender that this machine cannot run."""
    reasons = {case.contender: LIBRARIES[case.library].lacks() for case in CASES}
    return [f"{contender}: {reason}" for contender, reason in reasons.items() if reason]


def run(protocol: Protocol, only: str) -> list[Measurement]:
    """Measure the contenders in turns, A B C A B C, and say what comes out."""
    able = [case for case in CASES if not LIBRARIES[case.library].lacks()]
    chosen = [case for case in able if only in f"{case.setting}: {case.contender}"]
    plan = [(r, case) for r in range(protocol.repetitions) for case in chosen if case.repeated or r == 0]
    measurements = []
    for number, (repetition, case) in enumerate(plan, start=1):
        measurement = measure(case, repetition, protocol)
        measurements.append(measurement)
        print(
            f"[{number}/{len(plan)}] {case.setting}: {case.contender} {measurement.steps_per_second:.1f} steps/s "
            f"(start {measurement.start_seconds:.1f} s, {measurement.peak_mib:.0f} MiB, "
            f"other load {measurement.other_load:.2f})",
            flush=True,
        )
    return measurements


def main() -> None:
    """Measure, print the report and, where a folder is given, write it there."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for speed.csv and, between its markers, README.md")
    parser.add_argument("--repetitions", type=int, default=Protocol().repetitions)
    parser.add_argument("--only", default="", help="measure the cases whose 'setting: contender' contains this")
    parser.add_argument("--quick", action="store_true", help="one short repetition, to see that it runs; not written")
    arguments = parser.parse_args()
    if not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2:
        sys.exit("the benchmark needs Linux and two processors")
    if not Path(PEERS_PYTHON).exists():
        sys.exit(f"there is no {PEERS_PYTHON}: run `make peers` first")

    protocol = QUICK if arguments.quick else Protocol(repetitions=arguments.repetitions)
    for line in lacking():
        print(f"not measured: {line}", flush=True)
    began = time.monotonic()
    measurements = run(protocol, arguments.only)
    if not measurements:
        sys.exit(f"no case contains {arguments.only!r}")
    report = markdown(measurements, REACHES, describe_machine(measurements, protocol))
    print(f"\n{report}\n{(time.monotonic() - began) / 60:.1f} minutes")
    if arguments.out and not arguments.quick:
        write_csv(arguments.out / "speed.csv", measurements)
        write_between_markers(arguments.out / "README.md", report)


if __name__ == "__main__":
    main()
