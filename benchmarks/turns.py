"""Five seeds on two cores: turns of other lengths, a core for each, fewer processes. Updates alone, no environment.

    python -m benchmarks.turns                # about half an hour on a quiet machine

As csac's scheduler does it, a core goes to the process that is furthest behind, for so many steps.
"""

from __future__ import annotations

import argparse
import time
from multiprocessing.connection import wait
from typing import TYPE_CHECKING

from benchmarks.dispatch import Rates, Variant, start, summary

if TYPE_CHECKING:
    from collections.abc import Sequence

    from csac.processes import Child

EACH = 4_000  # steps of each seed in a window
ONE_EACH = [Variant(f"seed {i}", cores=(i % 2,)) for i in range(5)]
TOGETHER = [Variant("three seeds", cores=(0,), seeds=3), Variant("two seeds", cores=(1,), seeds=2)]
TURNS = {  # name: processes, steps of a turn, whether each process keeps to its core
    "turns of 250": (ONE_EACH, 250, False),
    "turns of 1,000": (ONE_EACH, 1_000, False),
    "turns of 4,000": (ONE_EACH, 4_000, False),
    "turns of 250, each on its core": (ONE_EACH, 250, True),
    "two processes, 3 and 2 seeds": (TOGETHER, 4_000, True),
}


def compare_turns(rounds: int, rates: Rates, costs: Rates) -> None:
    """Add the steps per second of five seeds, if both cores were busy throughout, for every way to share the cores."""
    children = {id(variants): start(variants) for variants in (ONE_EACH, TOGETHER)}
    for number in range(rounds):
        for name, (variants, steps, keeps) in list(TURNS.items())[:: 1 if number % 2 else -1]:
            seconds, processor = share(children[id(variants)], variants, steps, keeps)
            total = EACH * sum(variant.seeds for variant in variants)
            rates[name].append(2 * total / seconds)
            costs[name].append(1e3 * processor / total)
    for child in (child for some in children.values() for child in some):
        child.kill()


def share(children: Sequence[Child], variants: Sequence[Variant], steps: int, keeps: bool) -> tuple[float, float]:
    """Hand out two cores in turns until all have made EACH steps; return the seconds of all turns, and processors'."""
    done, free, began, seconds, processor = [0] * len(children), {0, 1}, {}, 0.0, 0.0
    while min(done) < EACH or began:
        for core in sorted(free):
            idle = [i for i in range(len(children)) if i not in began and done[i] < EACH]
            if idle := [i for i in idle if not keeps or variants[i].cores == (core,)]:
                chosen = min(idle, key=lambda i: done[i])
                began[chosen] = core, time.perf_counter()
                free.remove(core)
                children[chosen].tell(((core,), steps))
        ready = wait([children[i].connection for i in began])
        for i in [i for i in began if children[i].connection in ready]:
            processor += children[i].connection.recv()[1]
            core, since = began.pop(i)
            seconds, done[i] = seconds + time.perf_counter() - since, done[i] + steps
            free.add(core)
    return seconds, processor


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--repetitions", type=int, default=3, help="new processes for each")
    options = parser.parse_args(arguments)
    rates, costs = ({name: [] for name in TURNS} for _ in range(2))
    for _ in range(options.repetitions):
        compare_turns(options.rounds, rates, costs)
    print(summary(rates, costs))


if __name__ == "__main__":
    main()
