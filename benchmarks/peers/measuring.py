"""What the peers' scripts share: their arguments, and the window in which steps are counted.

Nothing but the standard library is imported here, for the peers do not all live in one environment.
"""

import argparse
import json
import os
import resource
import sys
import time
import warnings

STEPS = 1_000_000  # what training is asked for, and never reached: the window ends it


def argument_parser(description, algorithms):
    """Return a parser of what `python -m benchmarks peers` gives; by hand, most of it has defaults."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithm", choices=algorithms, default=algorithms[0])
    parser.add_argument("--task", default="HalfCheetah-v4")
    parser.add_argument("--seeds", type=int, choices=(1,), default=1)
    parser.add_argument("--threads", type=int, help="of the library's own; one for each processor by default")
    parser.add_argument("--launched", type=float, help="time.monotonic() when this process was started")
    parser.add_argument("--warmup", type=int, default=250, help="the first update follows this step")
    parser.add_argument("--settled", type=int, default=500, help="steps before the window begins")
    parser.add_argument("--seconds", type=float, default=5.0, help="the window lasts at least this long")
    parser.add_argument("--steps", type=int, default=1, help="the window has at least so many steps")
    parser.add_argument("--evaluation-interval", type=int, default=0, help="0 for no evaluation")
    parser.add_argument("--evaluation-episodes", type=int, default=10)
    parser.add_argument("--together", action="store_true", help="say `ready` and wait for a line before the window")
    return parser


def parse(parser, evaluates=False, given=None):
    """Return the arguments, those of this process unless `given`; `evaluates` if the script can while it trains."""
    arguments = parser.parse_args(given)
    if arguments.evaluation_interval and not evaluates:
        parser.error("this peer is measured without evaluation")
    if arguments.launched is None:
        arguments.launched = time.monotonic()
    arguments.threads = arguments.threads or len(os.sched_getaffinity(0))
    warnings.filterwarnings("ignore")
    return arguments


class Window:
    """Notes the first update, and when the window began and ended.

    Ask `is_over_at` after each update and before the environment's next step, the first time after the first update.
    """

    def __init__(self, arguments):
        self.arguments = arguments
        self.start_seconds = self.begin = self.end = 0.0
        self.first = self.steps = 0

    def is_over_at(self, steps):
        """Return whether the window is over, after so many steps of the environment and the update of the last."""
        if not self.start_seconds and steps >= self.arguments.warmup:
            self.start_seconds = time.monotonic() - self.arguments.launched
        if steps < self.arguments.settled:
            return False
        if not self.begin:
            self._wait_for_the_others()
            self.begin, self.first = time.monotonic(), steps
        self.end, self.steps = time.monotonic(), steps - self.first
        return self.end - self.begin >= self.arguments.seconds and self.steps >= self.arguments.steps

    def _wait_for_the_others(self):
        if self.arguments.together:
            print("ready", flush=True)
            sys.stdin.readline()

    def report(self, returns):
        """Print what was measured, and the returns of the last training episodes, oldest first: they should rise."""
        result = {
            "start_seconds": self.start_seconds,
            "steps": self.steps,
            "seconds": self.end - self.begin,
            "steps_per_second": self.steps / (self.end - self.begin),
            "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "returns": [round(float(value)) for value in returns],
        }
        print(json.dumps(result), flush=True)
