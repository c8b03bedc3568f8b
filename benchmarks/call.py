"""Run one measurement in a separate process: `python -m benchmarks.call module:function JSON` prints a line of JSON."""

from __future__ import annotations

import json
import sys
from importlib import import_module


def main() -> None:
    """Call the function with the arguments and print its result."""
    _, function, arguments = sys.argv
    module, _, name = function.partition(":")
    print(json.dumps(getattr(import_module(module), name)(**json.loads(arguments))), flush=True)


if __name__ == "__main__":
    main()
