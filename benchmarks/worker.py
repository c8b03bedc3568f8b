"""One measurement in a process of its own: `python -m benchmarks.worker MODULE ARGUMENTS` prints one line of JSON.

`measuring.worker` makes this command, and `measuring.run` starts it, bound to its processors.
"""

from __future__ import annotations

import json
import sys
from importlib import import_module


def main() -> None:
    """Call `measure` of that module of `benchmarks.workers` with the arguments, which are JSON."""
    _, module, arguments = sys.argv
    measure = import_module(f"benchmarks.workers.{module}").measure
    print(json.dumps(measure(**json.loads(arguments))), flush=True)


if __name__ == "__main__":
    main()
