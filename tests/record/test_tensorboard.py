from contextlib import closing

import pytest
from scalars import purges, scalars

from csac.record.tensorboard import TensorBoardLog


@pytest.fixture
def log(tmp_path):
    times = iter([10.0, 12.0])
    log = TensorBoardLog(tmp_path, [0, 7], clock=lambda: next(times))
    yield log
    log.close()


def test_each_seed_has_a_directory_and_metrics_their_own_tags(log, tmp_path):
    rows = [{"seed": 0, "step": 1000, "critic_loss": 0.5}, {"seed": 7, "step": 1000, "critic_loss": 0.25}]
    log.write({"metrics": rows})
    log.close()

    # 1000 steps from 10 s to 12 s.
    assert scalars(tmp_path / "seed_0") == {"train/critic_loss": [(1000, 0.5)], "time/fps": [(1000, 500.0)]}
    assert scalars(tmp_path / "seed_7") == {"train/critic_loss": [(1000, 0.25)], "time/fps": [(1000, 500.0)]}


def test_training_episodes_are_averaged_over_the_last_hundred(log, tmp_path):
    log.write({"episodes": [{"seed": 0, "step": step, "return": 1.0, "length": 10} for step in range(1, 101)]})
    log.write({"episodes": [{"seed": 0, "step": step, "return": 5.0, "length": 30} for step in range(101, 151)]})
    log.close()

    # One point per call: a hundred ones, then fifty ones and fifty fives.
    assert scalars(tmp_path / "seed_0") == {
        "rollout/ep_rew_mean": [(100, 1.0), (150, 3.0)],
        "rollout/ep_len_mean": [(100, 10.0), (150, 20.0)],
    }
    assert scalars(tmp_path / "seed_7") == {}


def test_evaluations_are_averaged_per_seed_and_step(log, tmp_path):
    rows = [
        {"seed": seed, "step": step, "episode": episode, "return": value, "length": 4, "success": success}
        for seed, step, episode, value, success in [
            (0, 10, 0, 1.0, 1.0),
            (0, 10, 1, 2.0, 0.0),
            (0, 20, 0, 5.0, None),
            (7, 10, 0, 8.0, None),
        ]
    ]
    log.write({"evaluations": rows})
    log.close()

    assert scalars(tmp_path / "seed_0") == {
        "eval/mean_reward": [(10, 1.5), (20, 5.0)],
        "eval/mean_ep_length": [(10, 4.0), (20, 4.0)],
        "eval/success_rate": [(10, 0.5), (20, 0.0)],  # once episodes have spoken of it, silence is a no
    }
    assert scalars(tmp_path / "seed_7") == {
        "eval/mean_reward": [(10, 8.0)],
        "eval/mean_ep_length": [(10, 4.0)],
        "eval/success_rate": [(10, 0.0)],
    }


def test_a_run_that_goes_on_averages_with_what_it_has_already(tmp_path):
    """A hundred episodes of 1 to 100, success among them: the next point is the one of a run that was never stopped."""
    episodes = [{"seed": 0, "step": 10 * i, "return": float(i), "length": 10} for i in range(1, 101)]
    evaluation = {"seed": 0, "step": 1000, "episode": 0, "return": 1.0, "length": 4, "success": 1.0}
    with closing(TensorBoardLog(tmp_path, [0], 1000, {"episodes": episodes, "evaluations": [evaluation]})) as log:
        log.write({"episodes": [{"seed": 0, "step": 1010, "return": 101.0, "length": 10}]})
        log.write({"evaluations": [{**evaluation, "step": 1020, "success": None}]})
    told = scalars(tmp_path / "seed_0")
    assert told["rollout/ep_rew_mean"] == [(1010, 51.5)]
    assert told["eval/success_rate"] == [(1020, 0.0)]


def test_closing_twice_is_harmless(log):
    log.close()
    log.close()


def test_what_is_flushed_is_there_though_nothing_was_closed(log, tmp_path):
    log.write({"episodes": [{"seed": 7, "step": 5, "return": 1.0, "length": 10}]})
    log.flush()
    assert scalars(tmp_path / "seed_7")["rollout/ep_rew_mean"] == [(5, 1.0)]


@pytest.mark.parametrize(("begin", "purged"), [(0, [1]), (40, [41])])
def test_what_a_run_wrote_beyond_where_it_goes_on_is_dropped(tmp_path, begin, purged):
    """Also where it begins anew, since it was killed before its first checkpoint."""
    TensorBoardLog(tmp_path, [0]).close()
    assert purges(tmp_path / "seed_0") == []
    TensorBoardLog(tmp_path, [0], begin).close()
    assert purges(tmp_path / "seed_0") == purged
