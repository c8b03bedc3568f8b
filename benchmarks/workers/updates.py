"""Updates per second of one learner without an environment."""

from __future__ import annotations

import resource

from benchmarks.driver import Driver, make_learner
from csac.types import Spec


def measure(
    algorithm: str,
    seconds: float,
    interval: int = 1,
    observation: int = 17,
    width: int = 256,
    batch: int = 256,
    replay: int = 1_000_000,
) -> dict[str, float]:
    """Return the updates per second, `interval` of them in one dispatch, and the peak of the memory in MiB."""
    learner = make_learner(
        algorithm,
        Spec(observation, 6),
        actor_hidden_sizes=(width,) * 2,
        critic_hidden_sizes=(width,) * 2,
        batch_size=batch,
        replay_size=replay,
        update_interval=interval,
    )
    driver = Driver(learner, interval=interval)
    driver.run(min(seconds, 0.5))
    speed = driver.run(seconds)
    return {"updates_per_second": speed, "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}
