"""Entry point: `python -m benchmarks NAME` measures, prints a table and, with --write, inserts it into its page."""

from __future__ import annotations

import argparse
import sys
import time
from typing import TYPE_CHECKING

from benchmarks import checkpoint, gpu, growth, latency, limit, peers, start, stepping, vector
from benchmarks.measuring import usable_cores
from benchmarks.part import Options, Part, shown
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

SUITES = {
    "peers": peers,
    "start": start,
    "limit": limit,
    "growth": growth,
    "gpu": gpu,
    "checkpoint": checkpoint,
    "latency": latency,
    "stepping": stepping,
    "vector": vector,
}
PARTS: list[Part] = [part for suite in SUITES.values() for part in suite.PARTS]


def named(name: str) -> list[Part]:
    """Return the parts of a suite, or the one part with this name.

    Raises:
        InputError: no suite or part has this name.
    """
    parts = SUITES[name].PARTS if name in SUITES else [part for part in PARTS if part.name == name]
    if not parts:
        raise InputError(f"no benchmark is called {name!r}: choose among {', '.join(_names())}, render")
    return list(parts)


def measure(part: Part, options: Options, write: bool) -> bool:
    """Measure one part, print its table and optionally write it; return whether anything was measured."""
    began = time.monotonic()
    rows = part.run(options)
    if not rows:
        return False
    notes = part.all_notes(rows, options)
    print(f"\n{shown(part.table(rows), notes)}\n{(time.monotonic() - began) / 60:.1f} minutes", flush=True)
    if write and not (options.quick or options.only):
        part.write(rows, notes)
        part.publish()
    elif write:
        print(f"not written: only a part of {part.name} was measured, or quickly")
    return True


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return the exit code."""
    given = _parser().parse_args(arguments)
    options = Options(given.only, given.repetitions, given.quick, given.device)
    try:
        if given.name == "render":
            for part in PARTS:
                part.publish()
            return 0
        parts = named(given.name)
        if not sys.platform.startswith("linux") or len(usable_cores()) < 2:
            raise InputError("the benchmarks need Linux and two cores")
        measured = [measure(part, options, given.write) for part in parts]
        if not any(measured):
            raise InputError(f"nothing in {given.name} can be measured here whose name contains {given.only!r}")
    except InputError as error:
        print(f"benchmarks: {error}", file=sys.stderr)
        return 2
    return 0


def _names() -> list[str]:
    return list(dict.fromkeys([*SUITES, *(part.name for part in PARTS)]))


def _parser() -> argparse.ArgumentParser:
    lines = []
    for name, suite in SUITES.items():
        lines.append(f"  {name:16}  {(suite.__doc__ or '').splitlines()[0]}")
        lines += [f"  {part.name:16}    {part.about}" for part in suite.PARTS if len(suite.PARTS) > 1]
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure how fast csac is. NAME is one of:\n\n" + "\n".join(lines),
        epilog="Measure on a quiet machine: other programs cost more than most differences here.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("name", metavar="NAME", help="or `render`: all tables again, from benchmarks/results")
    parser.add_argument("--only", default="", metavar="TEXT", help="measure only what has this in its name, and print")
    parser.add_argument("--repetitions", type=int, help="how often each case is measured, in turns")
    parser.add_argument("--quick", action="store_true", help="see that it runs; the numbers mean nothing")
    parser.add_argument("--device", choices=("gpu", "cpu"), default="gpu", help="of the suite gpu")
    parser.add_argument("--write", action="store_true", help="write the rows to benchmarks/results, and the pages")
    return parser


if __name__ == "__main__":
    sys.exit(main())
