"""The script that draws several runs in one picture and prints their table."""

import runpy
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "results" / "compare.py"


@pytest.fixture
def compare(tmp_path, monkeypatch, capsys):
    """Compare runs, given as each seed's returns, and return the lines of the table."""

    def compared(**runs: list[list[float]]) -> list[str]:
        for name, seeds in runs.items():
            rows = [
                f"{seed},{10 * (t + 1)},0,{value},5," for seed, line in enumerate(seeds) for t, value in enumerate(line)
            ]
            (tmp_path / f"{name}.csv").write_text("\n".join(["seed,step,episode,return,length,success", *rows, ""]))
        files = [f"{name}={tmp_path / name}.csv" for name in runs]
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), "--out", str(tmp_path / "picture.png"), *files])
        runpy.run_path(str(SCRIPT), run_name="__main__")
        assert (tmp_path / "picture.png").stat().st_size > 10_000
        return capsys.readouterr().out.splitlines()

    return compared


def test_three_seeds_have_no_interquartile_mean(compare):
    head, _, row = compare(few=[[40.0], [50.0], [60.0]])
    assert "IQM" not in head
    assert row == "| few | 3 | 10 | 50 ± 10 | 25 to 75 | 1.00 | 50 at 10 |"  # 10 / sqrt(3) * t(2) = 24.8


def test_five_seeds_have_one_with_its_interval(compare):
    head, _, few, many, outlier = compare(
        few=[[40.0], [50.0], [60.0]],
        many=[[0.0, 100.0, 100.0, 100.0]] * 5,
        outlier=[[100.0], [200.0], [300.0], [400.0], [10_000.0]],
    )
    assert head.endswith("| maximum average return | IQM, 95 % bootstrap interval | above the first, probability |")
    assert few.endswith("| 50 at 10 | 50 |  |")  # too few for an interval
    assert many.endswith("| 2.00 | 100 at 20 | 100 (100 to 100) | 1.00 |")  # of the last three evaluations
    assert "| 300 (" in outlier  # the mean of 200, 300 and 400; the mean of all is 2200


def test_two_seeds_and_one_have_no_interval(compare):
    _, _, two, one = compare(two=[[40.0], [60.0]], one=[[30.0]])
    assert two == "| two | 2 | 10 | 50 ± 14 | 2 seeds: no interval | 1.00 | 50 at 10 |"
    assert one == "| one | 1 | 10 | 30 | 1 seed: no interval | 0.60 | 30 at 10 |"
