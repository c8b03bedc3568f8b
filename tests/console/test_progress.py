import io

import numpy as np
import pytest
from rich.console import Console

from csac.console.progress import Reporter, Speed, sparkline
from csac.console.tables import (
    duration,
    evaluation_table,
    make_console,
    number,
    recovery_tables,
    results_table,
    runs_table,
    short,
)
from csac.evaluation.evaluator import EvaluationEpisode
from csac.record.manifest import Manifest, State
from csac.record.run import RunDirectory

DIRECTORY = "runs/Hopper-v4/csac/now"


class Clock:
    """Stands still until told."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def plain():
    return Console(file=io.StringIO(), width=100, markup=False, highlight=False)


@pytest.fixture
def terminal():
    return Console(
        file=io.StringIO(), width=80, force_terminal=True, color_system=None, _environ={"TERM": "xterm-256color"}
    )


def text_of(renderable):
    file = io.StringIO()
    Console(file=file, width=500).print(renderable)
    return [" ".join(line.split()) for line in file.getvalue().splitlines() if line.strip(" ─")]


def lines(console):
    return console.file.getvalue().splitlines()


def make_run(path, returns, failures=(), state: State = "finished"):
    """A run whose evaluations at 10, 20, ... have one episode each, with `returns` [seed][point], and two episodes."""
    steps_done = 10 * max(len(line) for line in returns)
    run = RunDirectory.create(
        path,
        Manifest(
            task="Hopper-v4",
            algorithm="csac",
            seeds=tuple(range(len(returns))),
            steps=1000,
            steps_done=steps_done,
            state=state,
            failures=dict.fromkeys(failures, "step 20: reward is nan"),
        ),
    )
    rows = [
        {"seed": seed, "step": 10 * (point + 1), "episode": 0, "return": value, "length": 7, "success": None}
        for seed, line in enumerate(returns)
        for point, value in enumerate(line)
    ]
    run.append("evaluations", rows)
    run.append("episodes", [{"seed": 0, "step": step, "return": 1.0, "length": 5} for step in (5, 10)])
    return run


def test_elsewhere_than_on_a_terminal_every_evaluation_is_one_line(plain, clock):
    reporter = Reporter(plain, clock)
    reporter.start("Hopper-v4", "csac", [3, 4], 1000, DIRECTORY, ["memory: about 1 GiB"])
    reporter.progress({3: 100, 4: 100})
    clock.now += 2
    reporter.progress({3: 200, 4: 200})
    reporter.evaluated(200, {3: 12.5, 4: 1234.56})

    # 200 seed-steps in 2 s; 2 seeds x 800 steps are left.
    assert lines(plain) == [
        "csac on Hopper-v4, seeds 3 to 4, 1,000 steps each",
        DIRECTORY,
        "memory: about 1 GiB",
        "step 200 of 1,000: mean return 623.5 (seed 3 12.50, seed 4 1,234.6), 100 seed-steps/s, 16 s left",
    ]


def test_one_seed_needs_no_mean_of_seeds(plain, clock):
    reporter = Reporter(plain, clock)
    reporter.start("Hopper-v4", "csac", [0], 1000, DIRECTORY)
    reporter.evaluated(200, {0: -3.25})

    assert lines(plain)[-1] == "step 200 of 1,000: mean return -3.25"


def test_many_seeds_are_told_by_their_range(plain, clock):
    reporter = Reporter(plain, clock)
    reporter.start("Hopper-v4", "csac", list(range(20)), 1000, DIRECTORY)
    reporter.evaluated(200, {seed: float(seed) for seed in range(20)})

    assert lines(plain)[-1] == "step 200 of 1,000: mean return 9.50 (0.00 to 19.00)"


def test_silence_is_broken_after_half_a_minute_and_not_before(plain, clock):
    reporter = Reporter(plain, clock)
    reporter.start("Hopper-v4", "csac", [0, 1], 1000, DIRECTORY)
    before = len(lines(plain))
    for _ in range(61):
        reporter.progress({0: 10, 1: 20})
        clock.now += 1

    assert lines(plain)[before:] == ["step 10 of 1,000", "step 10 of 1,000"]


def test_a_failed_seed_is_named_with_its_reason_and_brackets_are_kept(plain, clock):
    reporter = Reporter(plain, clock)
    reporter.start("Hopper-v4", "csac", [0, 1], 1000, DIRECTORY)
    reporter.failed(1, 1234, "observation[3] is nan")

    assert lines(plain)[-1] == "seed 1 failed at step 1,234: observation[3] is nan"


def test_time_left_counts_living_seeds_only(plain, clock):
    reporter = Reporter(plain, clock)
    reporter.start("Hopper-v4", "csac", [0, 1], 1000, DIRECTORY)
    reporter.progress({0: 0, 1: 0})
    clock.now += 10
    reporter.progress({0: 500, 1: 500})
    reporter.failed(1, 500, "reward is nan")
    reporter.evaluated(500, {0: 1.0})

    assert lines(plain)[-1].endswith("100 seed-steps/s, 5 s left")


def test_a_long_path_is_not_broken_into_lines(plain, clock):
    path = "runs/" + "x" * 300

    Reporter(plain, clock).start("Hopper-v4", "csac", [0], 1000, path)

    assert path in lines(plain)


def test_a_terminal_shows_bar_curves_and_mean(terminal, clock):
    reporter = Reporter(terminal, clock)
    reporter.start("Hopper-v4", "csac", [0, 1], 100_000, DIRECTORY)
    reporter.progress({0: 25_000, 1: 25_000})
    reporter.evaluated(20_000, {0: 0.0, 1: 10.0})
    reporter.evaluated(25_000, {0: 70.0, 1: 30.0})
    reporter.close()

    shown = terminal.file.getvalue()
    assert "25 %, step 25k of 100k" in shown
    assert "return at step 25,000" in shown
    # The eight blocks span 0 to 70, the range over both seeds.
    for line in ("seed 0  ▁█  70.00", "seed 1  ▂▄  30.00", "  mean  ▁▆  50.00"):
        assert line in shown


def test_a_terminal_keeps_a_failed_seed_out_of_the_mean(terminal, clock):
    reporter = Reporter(terminal, clock)
    reporter.start("Hopper-v4", "csac", [0, 1, 2], 100_000, DIRECTORY)
    reporter.evaluated(20_000, {0: 0.0, 1: 10.0, 2: 20.0})
    reporter.failed(1, 22_000, "reward is nan")
    reporter.close()

    shown = terminal.file.getvalue()
    assert "seed 1 failed at step 22,000: reward is nan" in shown
    assert "seed 1  ▅  10.00  stopped" in shown
    assert "mean  ▅  10.00" in shown


def test_closing_gives_the_cursor_back_and_may_be_repeated(terminal, clock):
    reporter = Reporter(terminal, clock)
    reporter.close()
    reporter.start("Hopper-v4", "csac", [0], 100, DIRECTORY)
    reporter.close()
    reporter.close()

    shown = terminal.file.getvalue()
    assert shown.rindex("\x1b[?25h") > shown.rindex("\x1b[?25l")


def test_the_end_shows_results_and_what_to_type_next(plain, clock, tmp_path):
    run = make_run(tmp_path / "my run", [[1.0, 2.0]])
    (run.path / "policy").mkdir()
    reporter = Reporter(plain, clock)
    reporter.start("Hopper-v4", "csac", [0], 1000, run.path)
    clock.now += 200
    reporter.finish(run)

    shown = lines(plain)
    assert "finished 20 steps in 3 min 20 s" in shown
    assert f"curve    {run.path}/curve.png" in shown
    assert f"test it  csac evaluate '{run.path}'" in shown
    assert f"watch it csac play '{run.path}' --video '{run.path}/play.mp4'" in shown


@pytest.mark.parametrize(
    ("failures", "state", "outcome"),
    [
        ([1], "failed", "finished 20 steps in 0 s, but 1 of 2 seeds failed"),
        ([0, 1], "failed", "failed at step 20 after 0 s"),
        ([], "interrupted", "stopped at step 20 of 1,000 after 0 s"),
    ],
)
def test_the_end_says_how_it_ended(plain, clock, tmp_path, failures, state, outcome):
    run = make_run(tmp_path / "run", [[1.0, 2.0], [3.0]], failures, state)

    Reporter(plain, clock).finish(run)

    assert outcome in lines(plain)
    assert sum("failed at step 20: reward is nan" in line for line in lines(plain)) == len(failures)


def test_a_run_without_evaluations_ends_without_a_table(plain, clock, tmp_path):
    run = make_run(tmp_path / "run", [[1.0]], state="interrupted")
    (run.path / "evaluations.csv").unlink()

    Reporter(plain, clock).finish(run)

    assert "no evaluations yet" in lines(plain)


def test_results_are_last_last_three_best_and_their_spread(tmp_path):
    # At 30 the mean over seeds is best: 6. Last three: means of (1, 2, 3) -> seed 0: (5+9+2)/3, seed 1: (5+3+4)/3.
    run = make_run(tmp_path / "run", [[0.0, 5.0, 9.0, 2.0], [8.0, 5.0, 3.0, 4.0]])

    assert text_of(results_table(run)) == [
        "seed last return last three best at step episodes",
        "0 2.00 5.33 9.00 30 2",
        "1 4.00 4.00 8.00 10 0",
        "mean 3.00 4.67 6.00 30",
        "± std 1.41 0.94 4.24",
        "± 95 % 12.71 8.47 38.12",  # 12.706 std / sqrt 2
    ]


def test_results_leave_failed_seeds_out_of_the_mean(tmp_path):
    run = make_run(tmp_path / "run", [[1.0, 1.0], [100.0], [3.0, 3.0]], failures=[1])

    assert [line for line in text_of(results_table(run)) if line.startswith("mean")] == ["mean 2.0 2.0 2.0 10"]


def test_results_of_one_seed_have_no_spread(tmp_path):
    run = make_run(tmp_path / "run", [[1.0, 2.0]])

    assert len(text_of(results_table(run))) == 2


def test_a_perturbed_run_shows_what_it_cost(tmp_path):
    run = make_run(tmp_path / "run", [[100.0, 100.0, 40.0, 95.0, 95.0], [200.0, 200.0, 100.0, 150.0, 100.0]])
    run.update_manifest(perturbations=["gravity=2", "friction=1.5@20", "mass=2@40", "gain=2@900"])
    first, second = (text_of(table) for table in recovery_tables(run))
    assert first == [
        "friction x 1.5 after step 20, until 40",
        "seed before drop relative steps to 90 % area lost final worst fall",
        "0 100.0 60.0 60% 20 625 67.5 60.0",
        "1 200.0 100.0 50% never 1.25k 125.0 100.0",
        "mean 150.0 80.0 55% 1 of 2 938 96.2 80.0",
        "± std 70.7 28.3 7% 442 40.7 28.3",
    ]
    assert second[0] == "mass x 2 after step 40"
    assert second[2].startswith("0 67.5 0.0 0% 0 0 95.0")


def test_a_perturbed_run_ends_with_its_table(plain, clock, tmp_path):
    run = make_run(tmp_path / "run", [[100.0, 40.0, 95.0]])
    run.update_manifest(perturbations=["friction=1.5@10"])
    reporter = Reporter(plain, clock)
    reporter.start("Hopper-v4", "csac", [0], 1000, run.path)
    reporter.finish(run)
    assert any("friction x 1.5 after step 10" in line for line in lines(plain))


def test_a_return_of_nothing_has_no_share_and_is_in_the_other_means(tmp_path):
    run = make_run(tmp_path / "run", [[0.0, -6.0], [-2.0, -4.0], [-4.0, -8.0]])
    run.update_manifest(perturbations=["friction=1.5@10"])
    (table,) = (text_of(table) for table in recovery_tables(run))
    assert table[5].split()[:5] == ["mean", "-2.00", "4.00", "100%", "0"]


def test_a_failed_seed_is_shown_and_not_in_the_mean_of_what_it_cost(tmp_path):
    run = make_run(tmp_path / "run", [[10.0, 5.0, 9.0], [20.0, 10.0, 18.0], [30.0, 1.0]], failures=[2])
    run.update_manifest(perturbations=["friction=1.5@10"])
    (table,) = (text_of(table) for table in recovery_tables(run))
    assert [line.split()[0] for line in table[2:]] == ["0", "1", "2", "mean", "±"]
    assert table[5].split()[:5] == ["mean", "15.00", "7.50", "50%", "20"]


def test_a_run_that_was_not_perturbed_shows_no_such_table(tmp_path):
    assert recovery_tables(make_run(tmp_path / "run", [[1.0, 2.0]])) == []


def test_evaluations_are_summed_up_per_seed():
    results = {
        0: [EvaluationEpisode(0, 1.0, 10, 1.0), EvaluationEpisode(1, 3.0, 20, 0.0)],
        5: [EvaluationEpisode(0, 6.0, 10, 1.0), EvaluationEpisode(1, 6.0, 10, 1.0)],
    }

    assert text_of(evaluation_table(results)) == [
        "seed mean return ± std min max length success",
        "0 2.00 1.41 1.00 3.00 15.0 50%",
        "5 6.00 0.00 6.00 6.00 10.0 100%",
        "mean 4.00",
        "± 95 % 25.41",  # 12.706 * 2.828 / sqrt 2
    ]


def test_runs_are_listed_with_what_is_known_of_them(tmp_path):
    done = make_run(tmp_path / "a", [[1.0, 4.0], [2.0, 8.0]])
    new = RunDirectory.create(
        tmp_path / "b", Manifest(task="Ant-v4", algorithm="sac", seeds=(0,), steps=2_500_000, state="running")
    )
    damaged = make_run(tmp_path / "c", [[1.0]])
    (damaged.path / "evaluations.csv").write_text("not a table\n")

    assert text_of(runs_table([done, new, damaged]))[1:] == [
        f"Hopper-v4 csac 2 20 / 1k finished 6.00 {done.path}",
        f"Ant-v4 sac 1 0 / 2.5M running {new.path}",
        f"Hopper-v4 csac 1 10 / 1k finished damaged {damaged.path}",
    ]


def test_a_running_run_whose_process_is_gone_was_killed(tmp_path):
    run = make_run(tmp_path / "a", [[1.0]], state="running")
    run.update_manifest(process=2**22 + 1)  # above any process id

    assert "killed" in text_of(runs_table([run]))[1]


def test_speed_looks_back_twenty_seconds(clock):
    speed = Speed(clock)
    assert speed.per_second() is None
    for total in (0, 10_000, 11_000, 12_000, 13_000):
        speed.add(total)
        clock.now += 10

    assert speed.per_second() == 100.0


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.4, "0 s"),
        (59.4, "59 s"),
        (60, "1 min"),
        (200, "3 min 20 s"),
        (3600, "1 h"),
        (6150, "1 h 42 min"),
        (97200, "1 d 3 h"),
    ],
)
def test_durations_have_two_units(seconds, text):
    assert duration(seconds) == text


@pytest.mark.parametrize(("steps", "text"), [(999, "999"), (12_500, "12.5k"), (663_250, "663.2k"), (1_000_000, "1M")])
def test_steps_in_little_room(steps, text):
    assert short(steps) == text


@pytest.mark.parametrize(
    ("value", "largest", "text"), [(1.234, None, "1.23"), (-1234.56, None, "-1,234.6"), (1.234, 5000.0, "1.2")]
)
def test_a_column_has_one_number_of_decimals(value, largest, text):
    assert number(value, largest) == text


def test_a_sparkline_spans_its_range_and_leaves_gaps():
    assert sparkline([0.0, 3.5, 7.0, np.nan, 99.0, -99.0], 0.0, 7.0, 10) == "▁▅█ █▁"
    assert sparkline(np.arange(80.0), 0.0, 79.0, 8) == "▁▂▃▄▅▆▇█"
    assert sparkline([5.0], 5.0, 5.0, 8) == "▅"
    assert sparkline([], 0.0, 0.0, 8) == ""


def test_a_console_outlives_its_reader(monkeypatch):
    class Closed(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

        def flush(self):
            raise BrokenPipeError

    monkeypatch.setattr("sys.stdout", Closed())

    make_console().print("nobody reads this")
