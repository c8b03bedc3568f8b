import numpy as np
import pytest
from shown import lines, make_run

from csac.console.progress import Reporter, sparkline
from csac.tasks.environment import Environment

DIRECTORY = "runs/Hopper-v4/csac/now"


def leave_policies(run):
    (run.path / "policy").mkdir()
    (run.path / "policy" / "seed_0.safetensors").touch()


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


def test_until_the_first_step_it_compiles(plain, terminal, clock):
    for console in (plain, terminal):
        reporter = Reporter(console, clock)
        reporter.start("Hopper-v4", "csac", [0, 1], 1000, DIRECTORY)
        clock.now += 45
        reporter.progress({0: 0, 1: 0})
        reporter.close()
    assert lines(plain)[-1] == "step 0 of 1,000, compiling for 45 s"
    assert "0 %, step 0 of 1k, compiling for 45 s" in terminal.file.getvalue()


def test_a_run_that_goes_on_compiles_until_it_makes_a_step_of_its_own(plain, clock):
    reporter = Reporter(plain, clock)
    reporter.start("Hopper-v4", "csac", [0], 1000, DIRECTORY)
    reporter.go_on(500, np.zeros(0, [("seed", int), ("step", int), ("return", float)]), {})
    for step in (500, 510):
        clock.now += 31
        reporter.progress({0: step})
    assert lines(plain)[-2:] == ["step 500 of 1,000, compiling for 31 s", "step 510 of 1,000"]


def test_nothing_is_left_at_the_last_step(plain, terminal, clock):
    for console in (plain, terminal):
        reporter = Reporter(console, clock)
        reporter.start("Hopper-v4", "csac", [0, 1], 3000, DIRECTORY)
        reporter.progress({0: 2000, 1: 2000})
        clock.now += 10
        reporter.progress({0: 2900, 1: 2900})  # of the last steps nobody has told yet
        reporter.evaluated(3000, {0: 1.0, 1: 2.0})
        reporter.close()
    assert lines(plain)[-1] == "step 3,000 of 3,000: mean return 1.50 (seed 0 1.00, seed 1 2.00), 180 seed-steps/s"
    assert "100 %, step 3k of 3k, finishing" in terminal.file.getvalue()


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
    leave_policies(run)
    reporter = Reporter(plain, clock)
    reporter.start("Hopper-v4", "csac", [0], 1000, run.path)
    clock.now += 200
    reporter.finish(run)

    shown = lines(plain)
    assert "finished 20 steps in 3 min 20 s" in shown
    assert f"curve    {run.path}/curve.png" in shown
    assert f"test it  csac evaluate '{run.path}'" in shown
    assert f"watch it csac play '{run.path}' --video '{run.path}/play.mp4'" in shown


def test_a_failure_is_told_once_where_nothing_comes_between(plain, clock, tmp_path):
    for name, evaluated in (("at once", False), ("long ago", True)):
        run = make_run(tmp_path / name, [[1.0], [2.0]])
        run.update_manifest(failures={0: "step 5: reward is nan"})
        reporter = Reporter(plain, clock)
        reporter.start("Hopper-v4", "csac", [0, 1], 1000, run.path)
        reporter.failed(0, 5, "reward is nan")
        if evaluated:
            reporter.evaluated(10, {1: 2.0})
        reporter.finish(run)
        told = plain.file.getvalue().count("seed 0 failed at step 5: reward is nan")
        assert told == (3 if evaluated else 1)  # of the second run it is told twice


def test_a_run_that_failed_before_it_was_evaluated_points_at_the_traceback_alone(plain, clock, tmp_path):
    run = make_run(tmp_path / "run", [[1.0]])
    (run.path / "evaluations.csv").unlink()
    leave_policies(run)  # of a seed that has learnt nothing, since its task does not run
    run.update_manifest(failures={0: "step 1: reset raised ValueError: no map"})
    run.log("seed 0 stopped at step 1: reset raised ValueError: no map\nTraceback (most recent call last):\n  ...")
    Reporter(plain, clock).finish(run)
    assert lines(plain)[-1] == f"why      the traceback is in {run.path}/log.txt"
    assert "test it" not in plain.file.getvalue()

    (run.path / "log.txt").write_text("2026-01-01T00:00:00+00:00 seed 0 stopped at step 1: reward is nan\n")
    Reporter(plain, clock).finish(run)
    assert plain.file.getvalue().count("why  ") == 1


@pytest.mark.parametrize(
    ("task", "is_watched"),
    [
        ("Hopper-v4", True),
        ("probes:Endless-v0", False),  # which draws nothing
        ("elsewhere:Unknown-v0", True),
    ],
)
def test_a_video_is_offered_where_it_can_be_made(plain, clock, tmp_path, task, is_watched):
    if not task.startswith("elsewhere:"):  # it is known of what this process has made
        Environment(task).close()
    run = make_run(tmp_path / "run", [[1.0]])
    leave_policies(run)
    run.update_manifest(task=task)
    Reporter(plain, clock).finish(run)
    assert ("watch it" in plain.file.getvalue()) == is_watched
    assert "test it" in plain.file.getvalue()


def test_what_is_to_be_typed_next_works(plain, clock, tmp_path):
    names = ("failed", "of_python", "nameless")
    failed, of_python, nameless = runs = [make_run(tmp_path / name, [[1.0]]) for name in names]
    for run in runs:
        leave_policies(run)
    failed.update_manifest(failures={0: "step 5: reward is nan"})  # whose best seed nobody can watch
    of_python.update_manifest(task="make_task", task_is_callable=True)  # which no command line can name
    nameless.update_manifest(task="Pendulum-v1", task_is_callable=True, environment_arguments={"g": 9.0})
    reporter = Reporter(plain, clock)
    for run in runs:
        reporter.start(run.manifest.task, "csac", [0], 1000, run.path)
        reporter.finish(run)

    shown = lines(plain)
    assert f"test it  csac evaluate {failed.path}" in shown
    assert f"test it  in Python: evaluate(load('{of_python.path}'), make_task)" in shown
    more = "your_task, environment_arguments={'g': 9.0}"
    assert f"test it  in Python: evaluate(load('{nameless.path}'), {more})" in shown
    assert "watch it" not in plain.file.getvalue()


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


def test_a_perturbed_run_ends_with_its_table(plain, clock, tmp_path):
    run = make_run(tmp_path / "run", [[100.0, 40.0, 95.0]])
    run.update_manifest(perturbations=["friction=1.5@10"])
    reporter = Reporter(plain, clock)
    reporter.start("Hopper-v4", "csac", [0], 1000, run.path)
    reporter.finish(run)
    assert any("friction x 1.5 after step 10" in line for line in lines(plain))


def test_a_sparkline_spans_its_range_and_leaves_gaps():
    assert sparkline([0.0, 3.5, 7.0, np.nan, 99.0, -99.0], 0.0, 7.0, 10) == "▁▅█ █▁"
    assert sparkline(np.arange(80.0), 0.0, 79.0, 8) == "▁▂▃▄▅▆▇█"
    assert sparkline([5.0], 5.0, 5.0, 8) == "▅"
    assert sparkline([], 0.0, 0.0, 8) == ""
