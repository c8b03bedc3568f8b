"""When a group says what, and what a scheduler makes of the ends of its processes."""

from __future__ import annotations

from typing import Any

import pytest
import trainer  # noqa: F401  (its cache of compiled programs)
from resuming import SMALL, run

from csac.algorithms import SAC


@pytest.mark.parametrize("interval", [100, 130])
def test_a_run_that_has_enough_ends_at_that_very_step(tmp_path, interval):
    """Evaluations between the steps where a group can be saved were told of up to 250 steps later."""
    told: list[int] = []

    def enough(step: int, _: Any) -> bool:
        told.append(step)
        return step == 2 * interval

    finished = run(tmp_path / "run", SAC(**SMALL), 500, "Pendulum-v1", evaluation_interval=interval, stop_when=enough)
    assert told == [interval, 2 * interval]
    assert (finished.manifest.steps_done, finished.manifest.state) == (2 * interval, "finished")
