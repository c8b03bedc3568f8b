"""Which ways to hand work to XLA pay: variants in turns, each in a process of its own that waits while others work.

    python -m benchmarks.dispatch                                    # all, about half an hour on a quiet machine
    python -m benchmarks.dispatch asynchronous --rounds 5 --only "sac, 2 cores"

`asynchronous`  updates alone, with JAX's asynchronous dispatch on and off
`training`      the same with HalfCheetah-v4, without evaluation
`evaluation`    whole intervals of 5,000 steps: no evaluation, in line, and beside
`copies`        updates alone, with and without XLA's region analysis of what it need not copy
`first`         several updates in one dispatch: what the first costs more than those that follow it
`references`    updates alone, and training: CSAC with the preset `paper`, and as it is by default
`critics`       updates alone, with plain critics, normalised ones, all five pieces, and (CSAC) the preset `strong`

A ratio is that of two measurements of one round. Processes of one kind differ, so each repetition starts new ones.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import statistics
import time
from itertools import count
from typing import TYPE_CHECKING, Any, NamedTuple

from benchmarks.measuring import TASK
from benchmarks.tables import table
from csac.presets import hyperparameters
from csac.processes import Child, die_with_parent, move_to

if TYPE_CHECKING:
    from collections.abc import Sequence
    from multiprocessing.connection import Connection

WARMUP = 500
NORMALISED = (("critic_normalisation", "batch"),)
RATES = (("critic_learning_rate", 1e-3), ("actor_learning_rate", 1e-3))
PIECES = (*NORMALISED, *RATES, ("policy_delay", 3), ("adam_momentum", 0.5), ("normalise_observations", True))
DEFAULT = (("reference_policy", "average"), ("relative_entropy_estimator", "closed_form"), ("reference_rate", 0.05))
STRONG = tuple((hyperparameters("strong", "csac", TASK) | {"warmup_steps": 0}).items())
REGIONS = "--xla_cpu_copy_insertion_use_region_analysis=true"
Rates = dict[str, list[float]]


class Variant(NamedTuple):
    """One process: how it trains, and how many steps it makes at a time."""

    name: str
    algorithm: str = "sac"
    cores: tuple[int, ...] = (0, 1)
    asynchronous: bool = True
    steps: int = 400
    interval: int = 1  # updates in one dispatch
    seeds: int = 1  # side by side in one program
    evaluation: str | None = None  # None: no environment at all; else "off", "in line" or "beside"
    flags: str = ""  # of XLA
    changes: tuple[tuple[str, Any], ...] = ()  # of the paper's hyperparameters


def suites() -> dict[str, dict[str, list[Variant]]]:
    """Return what is compared, by suite and setting; the first variant is what the others are compared with."""
    both = (0, 1)
    alone = {f"{name}, {len(cores)} cores": (name, cores) for name in ("sac", "csac", "td3") for cores in (both, (0,))}
    return {
        "asynchronous": {
            title: [Variant("off", *setting, False), Variant("on", *setting)] for title, setting in alone.items()
        },
        "training": {
            title: [Variant(way, *setting, way == "on", evaluation="off") for way in ("off", "on")]
            for title, setting in alone.items()
        },
        "evaluation": {
            f"csac, dispatch {'on' if on else 'off'}": [
                Variant(way, "csac", both, on, 5_000, evaluation=way) for way in ("off", "in line", "beside")
            ]
            for on in (True, False)
        },
        "copies": {
            title: [Variant("default", *setting), Variant("region", *setting, flags=REGIONS)]
            for title, setting in alone.items()
        },
        "first": {
            title: [Variant(f"{n} in one", *setting, interval=n) for n in (1, 2, 4, 8)]
            for title, setting in alone.items()
        },
        "references": {
            title: [Variant("preset paper", *setting), Variant("default", *setting, changes=DEFAULT)]
            for title, setting in {
                **{f"updates, {len(cores)} cores": ("csac", cores) for cores in (both, (0,))},
                "training, 2 cores": ("csac", both, True, 400, 1, 1, "off"),
            }.items()
        },
        "critics": {
            title: [
                Variant(kind, *setting, changes=changes)
                for kind, changes in (("plain", ()), ("normalised", NORMALISED), ("all pieces", PIECES))
            ]
            + [Variant("strong", *setting, changes=STRONG)] * (setting[0] == "csac")
            for title, setting in alone.items()
        },
    }


def work(connection: Connection, variant: Variant) -> None:
    """Make steps as told, (cores, steps), and answer (seconds, processor seconds); begin with the warm-up."""
    die_with_parent()
    move_to(variant.cores)
    os.environ["XLA_FLAGS"] = variant.flags
    import jax

    jax.config.update("jax_platforms", "cpu")
    jax.config.update("jax_cpu_enable_async_dispatch", variant.asynchronous)
    from benchmarks.driver import Driver, make_learner, make_settings
    from csac.training.group import Group

    changes = {"update_interval": variant.interval, **dict(variant.changes)}
    learner = make_learner(variant.algorithm, seeds=variant.seeds, **changes)
    if variant.evaluation:
        algorithm = dataclasses.replace(learner.algorithm, warmup_steps=WARMUP)  # pyright: ignore[reportArgumentType]
        interval, beside = 10**6 if variant.evaluation == "off" else 5_000, int(variant.evaluation == "beside")
        settings = make_settings(algorithm, TASK, 10**6, evaluation_interval=interval, evaluation_processes=beside)
        trained = Group(settings, [0])
        events = trained.run(lambda: False)
    else:
        trained = Driver(learner, variant.seeds)
        events = (trained.make(1) for _ in count())

    def advance(steps: int) -> None:
        until = trained.step + steps
        while trained.step < until:
            next(events)

    advance(5_000 if variant.evaluation in ("in line", "beside") else 2 * WARMUP)
    connection.send(None)
    while True:
        cores, steps = connection.recv()
        move_to(cores)
        began, processor = time.perf_counter(), time.process_time()
        advance(steps)
        connection.send((time.perf_counter() - began, time.process_time() - processor))


def start(variants: Sequence[Variant]) -> list[Child]:
    """Start a process for each, one after the other, and return them once they are warm."""
    children = []
    for variant in variants:
        children.append(Child(work, variant, daemon=False))
        children[-1].connection.recv()
    return children


def compare(variants: Sequence[Variant], rounds: int, rates: Rates, costs: Rates) -> None:
    """Add each variant's updates per second, and processor milliseconds of one, for every round."""
    pairs = list(zip(start(variants), variants, strict=True))
    for number in range(rounds):
        for child, variant in pairs if number % 2 else reversed(pairs):
            child.tell((variant.cores, variant.steps))
            seconds, processor = child.connection.recv()
            rates[variant.name].append(variant.steps / seconds)
            costs[variant.name].append(1e3 * processor / variant.steps)
    for child, _ in pairs:
        child.kill()


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print one table for each setting."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("suites", nargs="*", choices=suites(), default=list(suites()))
    parser.add_argument("--only", default="", help="settings whose name contains this")
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--repetitions", type=int, default=3, help="new processes for each")
    options = parser.parse_args(arguments)
    if min(options.rounds, options.repetitions) < 1 or options.rounds * options.repetitions < 2:
        parser.error("--rounds times --repetitions must be at least 2: one measurement has no middle half")
    for suite in options.suites:
        for setting, variants in suites()[suite].items():
            if options.only in setting:
                rates, costs = ({variant.name: [] for variant in variants} for _ in range(2))
                for _ in range(options.repetitions):
                    compare(variants, options.rounds, rates, costs)
                print(f"\n{suite}: {setting}\n\n{summary(rates, costs)}", flush=True)


def summary(rates: Rates, costs: Rates) -> str:
    """Return the table: medians, and the middle half of the ratios to the first variant in the same round."""
    rows, base = [], next(iter(rates))
    for name, values in rates.items():
        low, middle, high = statistics.quantiles([a / b for a, b in zip(values, rates[base], strict=True)], n=4)
        cost = statistics.median(costs[name])
        rows.append(
            [name, f"{statistics.median(values):.0f}", f"{middle:.3f} ({low:.3f} to {high:.3f})", f"{cost:.2f}"]
        )
    return table(["", "updates/s", "ratio (middle half)", "processor ms for one, this process"], rows)


if __name__ == "__main__":
    main()
