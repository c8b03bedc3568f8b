from contextlib import closing

import pytest
from scalars import purges, scalars

from csac.record import tensorboard
from csac.record.tensorboard import TensorBoardLog


@pytest.fixture
def log(tmp_path, monkeypatch):
    times = iter([10.0, *[12.0] * 100])
    monkeypatch.setattr(tensorboard.time, "monotonic", lambda: next(times))
    with closing(TensorBoardLog(tmp_path)) as log:
        yield log


def test_metrics_have_tags_of_their_own(log, tmp_path):
    assert log.write("metrics", [{"seed": 0, "step": 1000, "critic_loss": 0.5}]) == {
        1000: {"train/critic_loss": 0.5, "time/fps": 500.0}
    }
    log.close()
    # 1000 steps from 10 s to 12 s.
    assert scalars(tmp_path) == {"train/critic_loss": [(1000, 0.5)], "time/fps": [(1000, 500.0)]}


def test_training_episodes_are_averaged_over_the_last_hundred(tmp_path):
    before = [{"seed": 0, "step": step, "return": 1.0, "length": 10} for step in range(1, 101)]
    with closing(TensorBoardLog(tmp_path, 100, before)) as log:
        log.write("episodes", [{"seed": 0, "step": 150, "return": 5.0, "length": 30} for _ in range(50)])
    assert scalars(tmp_path) == {"rollout/ep_rew_mean": [(150, 3.0)], "rollout/ep_len_mean": [(150, 20.0)]}


def test_evaluations_are_averaged_by_step_and_once_a_case_is_told_of_silence_is_a_no(tmp_path):
    rows = [
        {"seed": 0, "step": step, "episode": episode, "return": value, "length": 4, "success": success, "fell": None}
        for step, episode, value, success in [(10, 0, 1.0, 1.0), (10, 1, 2.0, 0.0), (20, 0, 5.0, None)]
    ]
    with closing(TensorBoardLog(tmp_path)) as log:
        log.write("evaluations", rows)
    with closing(TensorBoardLog(tmp_path, 20, cases=["fell"])) as log:
        log.write("evaluations", [{**rows[-1], "step": 30}])
    assert scalars(tmp_path) == {
        "eval/mean_reward": [(10, 1.5), (20, 5.0), (30, 5.0)],
        "eval/mean_ep_length": [(10, 4.0), (20, 4.0), (30, 4.0)],
        "eval/success_rate": [(10, 0.5), (20, 0.0)],
        "eval/fell": [(30, 0.0)],
    }


def test_what_is_flushed_is_there_though_nothing_was_closed(log, tmp_path):
    log.write("episodes", [{"seed": 7, "step": 5, "return": 1.0, "length": 10}])
    log.flush()
    assert scalars(tmp_path)["rollout/ep_rew_mean"] == [(5, 1.0)]


@pytest.mark.parametrize(("begin", "purged"), [(0, [1]), (40, [41])])
def test_what_a_run_wrote_beyond_where_it_goes_on_is_dropped(tmp_path, begin, purged):
    """Also where it begins anew, since it was killed before its first checkpoint."""
    TensorBoardLog(tmp_path).close()
    assert purges(tmp_path) == []
    log = TensorBoardLog(tmp_path, begin)
    log.close()
    log.close()
    assert purges(tmp_path) == purged
