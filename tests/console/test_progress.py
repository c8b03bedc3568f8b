import numpy as np
import pytest
from shown import lines, make_set

from csac.console.progress import Reporter, sparkline


@pytest.fixture
def watch(clock, tmp_path):
    """A reporter of new runs on a console."""

    def start(console, seeds=2, steps=1000, notes=(), **values):
        reporter = Reporter(console, clock)
        runs = make_set(tmp_path / f"runs {len(list(tmp_path.iterdir()))}", [[]] * seeds, steps=steps, **values)
        reporter.start(runs, notes)
        return reporter

    return start


def test_elsewhere_than_on_a_terminal_an_evaluation_of_all_seeds_is_one_line(plain, clock, watch):
    reporter = watch(plain, notes=["memory: about 1 GiB"])
    head = lines(plain)
    assert head[0] == "csac on Hopper-v4, seeds 0, 1, 1,000 steps each"
    assert head[-1] == "memory: about 1 GiB"
    reporter.progress({0: 100, 1: 100})
    clock.now += 2
    reporter.progress({0: 200, 1: 200})
    reporter.evaluated(200, {0: 12.5})
    reporter.evaluated(300, {0: 13.5})
    assert lines(plain) == head
    reporter.evaluated(200, {1: 1234.56})
    # 200 seed-steps in 2 s; 700 and 800 steps are left.
    told = "step 200 of 1,000: mean return 623.5 (seed 0 12.50, seed 1 1,234.6), 100 seed-steps/s, 15 s left"
    assert lines(plain)[len(head) :] == [told]


def test_one_seed_needs_no_mean_and_of_many_there_is_a_range(plain, watch):
    watch(plain, seeds=1).evaluated(200, {0: -3.25})
    assert lines(plain)[-1] == "step 200 of 1,000: mean return -3.25"
    watch(plain, seeds=20).evaluated(200, {seed: float(seed) for seed in range(20)})
    assert lines(plain)[-1] == "step 200 of 1,000: mean return 9.50 (0.00 to 19.00)"


def test_silence_is_broken_after_half_a_minute(plain, clock, watch):
    reporter = watch(plain)
    before = len(lines(plain))
    for _ in range(61):
        reporter.progress({0: 12, 1: 8})
        clock.now += 1
    assert lines(plain)[before:] == ["step 8 to 12 of 1,000"] * 2


def test_until_the_first_step_of_its_own_a_run_compiles(plain, terminal, clock, watch):
    for console in (plain, terminal):
        reporter = watch(console, last_checkpoint=500, steps_done=600)  # 100 of these are lost
        clock.now += 45
        reporter.progress({0: 500, 1: 500})
        reporter.close()
    assert lines(plain)[-1] == "step 500 of 1,000, compiling for 45 s"
    assert "50 %, step 500 of 1k, compiling for 45 s" in terminal.file.getvalue()


def test_the_quick_steps_of_the_warm_up_say_nothing_of_the_time_left(plain, clock, watch):
    reporter = watch(plain, hyperparameters={"warmup_steps": 300})
    for step in (100, 250):
        clock.now += 1
        reporter.progress({0: step, 1: step})
    reporter.evaluated(250, {0: 1.0, 1: 1.0})
    assert lines(plain)[-1].endswith(", 300 random steps before learning")
    for step in (300, 400):
        clock.now += 10
        reporter.progress({0: step, 1: step})
    reporter.evaluated(400, {0: 1.0, 1: 1.0})
    assert lines(plain)[-1].endswith(", 15 seed-steps/s, 1 min 20 s left")


def test_nothing_is_left_at_the_last_step(plain, terminal, clock, watch):
    for console in (plain, terminal):
        reporter = watch(console, steps=3000)
        reporter.progress({0: 2000, 1: 2000})
        clock.now += 10
        reporter.evaluated(3000, {0: 1.0, 1: 2.0})
        reporter.close()
    assert lines(plain)[-1] == "step 3,000 of 3,000: mean return 1.50 (seed 0 1.00, seed 1 2.00), finishing"
    assert "100 %, step 3k of 3k, finishing" in terminal.file.getvalue()


def test_a_failed_seed_is_named_and_nobody_waits_for_it(plain, clock, watch):
    reporter = watch(plain)
    reporter.progress({0: 0, 1: 0})
    clock.now += 10
    reporter.progress({0: 500, 1: 500})
    reporter.failed(1, 500, "observation[3] is nan")
    assert lines(plain)[-1] == "seed 1 failed at step 500: observation[3] is nan"
    reporter.evaluated(500, {0: 1.0})
    assert lines(plain)[-1].endswith(": mean return 1.00, 100 seed-steps/s, 5 s left")


def test_a_terminal_shows_bar_curves_and_the_mean_of_the_living(terminal, watch):
    reporter = watch(terminal, seeds=3, steps=100_000)
    reporter.progress({0: 25_000, 1: 25_000, 2: 26_000})
    reporter.evaluated(20_000, {0: 0.0, 1: 10.0, 2: 70.0})
    reporter.evaluated(25_000, {0: 70.0, 1: 30.0})
    reporter.failed(2, 26_000, "reward is nan")
    reporter.close()
    shown = terminal.file.getvalue()
    assert "25 %, step 25k of 100k" in shown
    # The eight blocks span 0 to 70, the range over all seeds.
    for line in ("seed 0  25k  ▁█  70.00", "seed 1  25k  ▂▄  30.00", "seed 2  26k  █   70.00  stopped", "▁▆  50.00"):
        assert line in shown


def test_closing_gives_the_cursor_back_and_may_be_repeated(terminal, watch):
    reporter = watch(terminal)
    reporter.close()
    reporter.close()
    shown = terminal.file.getvalue()
    assert shown.rindex("\x1b[?25h") > shown.rindex("\x1b[?25l")


def with_policies(runs):
    for run in runs.runs:
        run.policies.mkdir()
        run.policy_file().touch()
    return runs


def test_the_end_shows_results_and_what_to_type_next(plain, clock, tmp_path):
    runs = with_policies(make_set(tmp_path / "my runs", [[1.0, 2.0]]))
    reporter = Reporter(plain, clock)
    reporter.start(runs)
    clock.now += 200
    reporter.finish(runs)
    assert "finished 20 steps in 3 min 20 s" in lines(plain)
    assert lines(plain)[-4:] == [
        f"curve    {runs.path}/curve.png",
        f"test it  csac evaluate '{runs.path}'",
        f"watch it csac play '{runs.path}' --video '{runs.path}/play.mp4'",
        f"export   csac export '{runs.path}' --format numpy",
    ]


def test_a_task_of_python_is_tested_in_python(plain, tmp_path):
    Reporter(plain).finish(with_policies(make_set(tmp_path, [[1.0]], task="make_task", task_is_callable=True)))
    assert lines(plain)[-1] == f"test it  in Python: evaluate(load('{tmp_path}'), make_task)"


def test_a_run_that_failed_at_once_points_at_its_log_alone(plain, tmp_path):
    runs = with_policies(make_set(tmp_path, [[]], failures=[0]))
    runs.runs[0].log("stopped at step 1: reset raised ValueError: no map\nTraceback (most recent call last):\n  ...")
    Reporter(plain).finish(runs)
    assert lines(plain)[-3:] == [
        "no evaluations",
        "seed 0 failed at step 20: reward is nan",
        f"why      see {tmp_path}/seed-0/log.txt",
    ]


@pytest.mark.parametrize(
    ("failures", "state", "outcome"),
    [
        ([1], "finished", "finished 20 steps in 0 s, but 1 of 2 seeds failed"),
        ([0, 1], "finished", "failed at step 10 after 0 s"),
        ([], "interrupted", "stopped at step 10 of 1,000 after 0 s"),
    ],
)
def test_the_end_says_how_it_ended(plain, clock, tmp_path, failures, state, outcome):
    Reporter(plain, clock).finish(make_set(tmp_path, [[1.0, 2.0], [3.0]], failures, state=state))
    assert outcome in lines(plain)
    assert sum("failed at step 20: reward is nan" in line for line in lines(plain)) == len(failures)


def test_a_sparkline_spans_its_range_and_leaves_gaps():
    assert sparkline([0.0, 3.5, 7.0, np.nan, 99.0, -99.0], 0.0, 7.0, 10) == "▁▅█ █▁"
    assert sparkline(np.arange(80.0), 0.0, 79.0, 8) == "▁▂▃▄▅▆▇█"
    assert sparkline([5.0], 5.0, 5.0, 8) == "▅"
    assert sparkline([], 0.0, 0.0, 8) == ""
