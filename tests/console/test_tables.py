import io

import pytest
from rich.console import Console
from shown import lines, make_run, shown_on, text_of

from csac.console.tables import (
    case_table,
    duration,
    evaluation_table,
    make_console,
    print_runs,
    recovery_tables,
    results_table,
)
from csac.evaluation.evaluator import EvaluationEpisode
from csac.record.manifest import Manifest
from csac.record.run import RunDirectory


def test_results_are_last_last_three_best_and_their_spread(tmp_path):
    # At 30 the mean over seeds is best: 6. Last three: means of (1, 2, 3) -> seed 0: (5+9+2)/3, seed 1: (5+3+4)/3.
    run = make_run(tmp_path / "run", [[0.0, 5.0, 9.0, 2.0], [8.0, 5.0, 3.0, 4.0]])

    assert text_of(results_table(run)) == [
        "seed last return last three best at step episodes",
        "0 2.00 5.33 9.00 30 2",
        "1 4.00 4.00 8.00 10 0",
        "mean 3.00 4.67 6.00 30",
        "± std 1.41 0.94 4.24",
        "2 seeds: no interval",
    ]


def test_three_seeds_have_an_interval(tmp_path):
    # 2, 4, 6 have std 2: 4.303 * 2 / sqrt 3 = 4.97
    run = make_run(tmp_path / "run", [[2.0], [4.0], [6.0]])

    assert text_of(results_table(run))[-2:] == ["± std 2.00 2.00 2.00", "± 95 % 4.97 4.97 4.97"]


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
        "seed before drop relative steps to 90 % area lost final drawdown",
        "0 100.0 60.0 60% 20 625 67.5 60.0",
        "1 200.0 100.0 50% never 1.25k 125.0 100.0",
        "mean 150.0 80.0 55% 1 of 2 938 96.2 80.0",
        "± std 70.7 28.3 7% 442 40.7 28.3",
    ]
    assert second[0] == "mass x 2 after step 40"
    assert second[2].startswith("0 67.5 0.0 0% 0 0 95.0")


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
        "2 seeds: no interval",
    ]


def test_a_seed_that_failed_is_in_no_mean():
    results = {seed: [EvaluationEpisode(0, value, 10, None)] for seed, value in ((0, 2.0), (1, 4.0), (2, -100.0))}
    assert text_of(evaluation_table(results, {2: "step 5: a reward is NaN"}))[-2:] == [
        "mean 3.0",
        "2 seeds: no interval",
    ]


def test_one_episode_has_no_spread():
    table = text_of(evaluation_table({0: [EvaluationEpisode(0, 1.0, 10, None)]}))
    assert table[1:] == ["0 1.00 1.00 1.00 10.0"]


def test_runs_are_listed_with_what_is_known_of_them(tmp_path, plain):
    done = make_run(tmp_path / "a", [[1.0, 4.0], [2.0, 8.0]])
    new = RunDirectory.create(
        tmp_path / "b", Manifest(task="Ant-v4", algorithm="sac", seeds=(0,), steps=2_500_000, state="running")
    )
    damaged = make_run(tmp_path / "c", [[1.0]])
    (damaged.path / "evaluations.csv").write_text("not a table\n")

    with new.locked():
        print_runs(plain, [done, new, damaged])
    shown = lines(plain)
    assert shown[0] == str(done.path)
    assert [line.strip() for line in shown[1::2]] == [
        "Hopper-v4, csac, 2 seeds, 20 / 1k steps, finished, last return 6.00",
        "Ant-v4, sac, 1 seed, 0 / 2.5M steps, running",
        "Hopper-v4, csac, 1 seed, 10 / 1k steps, finished, last return damaged",
    ]


def test_the_last_return_of_a_run_is_of_the_seeds_that_have_not_failed(tmp_path, plain):
    failed = make_run(tmp_path / "a", [[1.0, 4.0], [2.0, -900.0], [3.0, 6.0]], failures=[1])
    print_runs(plain, [failed, make_run(tmp_path / "b", [[1.0]], failures=[0])])
    assert [line.strip().split("steps, ")[1] for line in lines(plain)[1::2]] == [
        "finished, last return 5.00",
        "finished",
    ]
    assert set(failed.sound_evaluations["seed"]) == {0, 2}


def test_runs_are_a_table_where_there_is_room_for_it(tmp_path):
    run = make_run(tmp_path / "a", [[1.0, 4.0], [2.0, 8.0]])
    console = Console(file=io.StringIO(), width=200)
    print_runs(console, [run])

    assert lines(console)[3].split() == ["Hopper-v4", "csac", "2", "20", "/", "1k", "finished", "6.00", str(run.path)]


@pytest.mark.parametrize("width", [20, 40, 60, 80])
def test_no_path_and_no_task_is_cut_at_any_width(tmp_path, width):
    run = make_run(tmp_path / "a-run-with-a-long-name", [[1.0]])
    run.update_manifest(task="PyFlyt/QuadX-Waypoints-v1")
    console = Console(file=io.StringIO(), width=width)
    print_runs(console, [run])

    assert str(run.path) in lines(console)
    assert "PyFlyt/QuadX-Waypoints-v1" in shown_on(console)


@pytest.mark.parametrize("width", [30, 40, 52, 60, 200])
def test_no_digit_is_lost_at_any_width(tmp_path, width):
    run = make_run(tmp_path / "run", [[-123_456.7, 98_765.4], [11_111.1, 22_222.2], [33_333.3, 44_444.4]])
    run.update_manifest(perturbations=["friction=1.5@10"])
    console = Console(file=io.StringIO(), width=width)
    (recovery,) = recovery_tables(run)
    for table in (results_table(run), recovery):
        console.print(table)

    shown = " ".join(shown_on(console).split())
    for number in ("98,765.4", "-12,345.7", "55,144.0", "39,377.4", "-123,456.7", "-26,337.4", "84,838.5"):
        assert number in shown
    assert "…" not in shown
    assert all(len(line) <= width for line in lines(console))


def test_a_table_that_does_not_fit_goes_on_below_with_its_first_column(tmp_path):
    run = make_run(tmp_path / "run", [[1.0, 2.0], [3.0, 4.0]])
    console = Console(file=io.StringIO(), width=30)
    console.print(results_table(run))

    assert [line.split() for line in lines(console) if line.strip(" ─")] == [
        ["seed", "last", "return", "last", "three"],
        ["0", "2.00", "1.50"],
        ["1", "4.00", "3.50"],
        ["mean", "3.00", "2.50"],
        ["±", "std", "1.41", "1.41"],
        ["seed", "best", "at", "step", "episodes"],
        ["0", "2.00", "20", "2"],
        ["1", "4.00", "20", "0"],
        ["mean", "3.00", "20"],
        ["±", "std", "1.41"],
        ["2", "seeds:", "no", "interval"],
    ]


def test_cases_are_counted_in_1000_rollouts_and_silence_is_a_no():
    told = [{"crashed": True, "stops": 4}, {"crashed": None, "stops": None}, {"crashed": None, "stops": 1}]
    episodes = [EvaluationEpisode(n, 1.0, 5, 1.0 if n == 0 else None, events) for n, events in enumerate(told)]
    table = case_table({0: episodes})
    assert table is not None
    assert text_of(table) == [
        "per 1,000 rollouts (from 3 of each seed) seed 0",
        "success 333.3",
        "crashed 333.3",
        "stops (mean) 2.500",
    ]
    assert case_table({0: [EvaluationEpisode(0, 1.0, 5, None)]}) is None


def test_a_running_run_that_no_process_holds_was_killed(tmp_path, plain):
    """Whatever its process number says: another process may have it by now, here or on another machine."""
    run = make_run(tmp_path / "a", [[1.0]], state="running")
    run.update_manifest(process=1)
    with run.locked():
        print_runs(plain, [run])
    print_runs(plain, [run])
    assert [", running, " in lines(plain)[1], ", killed, " in lines(plain)[3]] == [True, True]


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


def test_a_console_outlives_its_reader(monkeypatch):
    class Closed(io.StringIO):
        def write(self, text):
            raise BrokenPipeError

        def flush(self):
            raise BrokenPipeError

    monkeypatch.setattr("sys.stdout", Closed())

    make_console().print("nobody reads this")


@pytest.mark.parametrize("output", [None, io.StringIO()])
def test_a_console_without_an_output_is_silent(monkeypatch, output):
    if output:
        output.close()
    monkeypatch.setattr("sys.stdout", output)

    make_console().print("nobody can read this")
