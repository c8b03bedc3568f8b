import io

import pytest
from rich.console import Console
from shown import lines, make_set, text_of

from csac.console.tables import (
    Fitted,
    duration,
    evaluation_tables,
    make_console,
    result_tables,
    run_lines,
)
from csac.evaluation.evaluator import EvaluationEpisode
from csac.record.rendering import Cell, Row, Table


def test_results_are_of_training_cases_and_perturbations(tmp_path):
    # At 30 the mean over seeds is best: 6. Last three: means of (1, 2, 3) -> seed 0: (5+9+2)/3, seed 1: (5+3+4)/3.
    runs = make_set(
        tmp_path, [[0.0, 5.0, 9.0, 2.0], [8.0, 5.0, 3.0, 4.0]], perturbations=("friction=1.5@10", "gain=2@900")
    )
    results, recovery = map(text_of, result_tables(runs))
    assert results == [
        "seed last return last three best at step episodes",
        "0 2.00 5.33 9.00 30 2",
        "1 4.00 4.00 8.00 10 2",
        "mean 3.00 4.67 6.00 30",
        "± std 1.41 0.94 4.24",
        "2 seeds: no interval",
    ]
    assert recovery[0] == "friction x 1.5 after step 10"


def test_evaluations_are_summed_up_by_seed():
    told = {0: [(1.0, 10, 1.0), (3.0, 20, None)], 5: [(6.0, 10, 1.0), (6.0, 10, 1.0)], 6: [(9.0, 5, 0.0)] * 2}
    episodes = {
        s: [EvaluationEpisode(n, e[0], e[1], e[2], {"fell": None}) for n, e in enumerate(several)]
        for s, several in told.items()
    }
    table, cases = map(text_of, evaluation_tables(episodes, {6: "step 5: a reward is NaN"}))
    assert table == [
        "seed mean return ± std min max length success",
        "0 2.00 1.41 1.00 3.00 15.0 50%",
        "5 6.00 0.00 6.00 6.00 10.0 100%",
        "6 9.00 0.00 9.00 9.00 5.0 0%",
        "mean 4.00",
        "2 seeds: no interval",
    ]
    assert cases[:2] == [
        "per 1,000 rollouts (from 2 of each seed) seed 0 seed 5 mean ± std",
        "success 500.0 1,000.0 750.0 ± 353.6",
    ]


def test_one_episode_has_no_spread():
    (table,) = map(text_of, evaluation_tables({0: [EvaluationEpisode(0, 1.0, 10, None)]}))
    assert table[1:] == ["0 1.00 1.00 1.00 10.0"]


def test_sets_are_listed_with_what_is_known_of_them(tmp_path):
    done = make_set(tmp_path / "a", [[1.0, 4.0], [2.0, -900.0], [3.0, 6.0]], failures=[1])
    new = make_set(tmp_path / "b", [[]], task="Ant-v4", algorithm="sac", steps=2_500_000, state="running", process=1)
    damaged = make_set(tmp_path / "c", [[1.0]])
    (damaged.runs[0].path / "evaluations.csv").write_text("not a table\n")
    with new.runs[0].locked():
        shown = [" ".join(line.plain.split()) for line in run_lines([done, new, damaged])]
    assert shown[1:] == [
        f"Hopper-v4 csac 3 20 / 1k failed 5.00 {done.path}",
        f"Ant-v4 sac 1 0 / 2.5M running {new.path}",
        f"Hopper-v4 csac 1 10 / 1k finished damaged {damaged.path}",
    ]
    assert " killed " in run_lines([new])[1].plain  # as no process holds its lock, whatever number that has


def test_where_a_table_is_too_narrow_no_digit_is_lost():
    table = Table(("a heading", "b"), (Row((Cell("-123,456.7", -123_456.7), Cell("98,765.4", 98_765.4))),))
    console = Console(file=io.StringIO(), width=14)
    console.print(Fitted(table))
    shown = "".join("".join(lines(console)).rpartition("─")[2].split())
    assert sorted(shown) == sorted("-123,456.798,765.4")


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
