"""What a checkpoint costs, in seconds and bytes, beside a replay of any size; and what looking for divergence costs."""

from __future__ import annotations

from benchmarks.measuring import run_one, worker
from benchmarks.parts import Options, Part
from benchmarks.tables import Row, formatted

SEEDS, NEW, CAPACITY = 5, 50_000, 1_000_000
HELD = [50_000, 100_000, 500_000, 1_000_000, 1_500_000]


def measure(_: str, options: Options) -> list[Row]:
    """Write checkpoints until the replay is over-full; say what reading them and looking for divergence takes."""
    part = 1_000 if options.quick else 1
    sizes = {"new": NEW // part, "capacity": CAPACITY // part, "held": [held // part for held in HELD]}
    updates = 10 if options.quick else 250
    found = run_one(worker("checkpoint", seeds=SEEDS, updates=updates, **sizes))
    print(f"reading and checking all of the last one: {found['reading']:.1f} s")
    look = f"{1e3 * found['look']:.2f} ms, {found['look_share']:.2%} of their time"
    print(f"looking for divergence every {updates} updates: {look}", flush=True)
    return found["rows"]


def render(rows: list[Row]) -> str:
    """Return a row for each checkpoint."""
    columns = {
        "transitions held by each seed": "{transitions:,}",
        "seconds": "{seconds:.2f}",
        "MiB written": "{written:.0f}",
        "MiB in the folder": "{held:.0f}",
    }
    sizes = [{"written": row["bytes"] / 2**20, "held": row["folder_bytes"] / 2**20} for row in rows]
    return formatted([row | size for row, size in zip(rows, sizes, strict=True)], columns)


PARTS = [Part("checkpoint", "docs/reliability.md", "seconds and bytes", ["five seeds"], measure, render)]
