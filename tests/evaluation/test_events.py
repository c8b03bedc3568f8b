"""Events of a task: what the last steps of episodes say, in tables, curves and counts."""

from __future__ import annotations

import os
import runpy
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from played import policy_for, run_of_task
from probes import Endless
from scalars import scalars

from csac.algorithms import SAC
from csac.cli import main
from csac.evaluation.evaluator import Evaluator
from csac.evaluation.play import evaluate_run
from csac.record.run import RunDirectory
from csac.record.tables import read_rows
from csac.seeds import EVALUATION_SEED, FRESH_EVALUATION_SEED
from csac.tasks import events
from csac.training.train import train
from csac.types import InputError

SUPPORT = Path(__file__).parents[1] / "support"
TINY = SAC(actor_hidden_sizes=(8,), critic_hidden_sizes=(8,), batch_size=8, warmup_steps=20, replay_size=200)
SHORT: dict[str, Any] = {"evaluation_interval": 20, "evaluation_episodes": 2, "checkpoint_interval": 20}


def story(number: int, first_seed: int = EVALUATION_SEED) -> tuple[bool, int]:
    """What an episode of `Cases` says at its end."""
    generator = np.random.Generator(np.random.PCG64(np.random.SeedSequence(first_seed + number)))
    return bool(generator.random() < 0.5), int(generator.integers(5))


class Unreadable:
    def __array__(self, *_, **__):
        raise TypeError("on another device")


def test_info_may_hold_anything():
    odd = (Unreadable(), [[1], [1, 2]], "3", b"3", None, np.nan, np.array([1, 2]), {})
    assert [events.number(value) for value in odd] == [None] * len(odd)
    good = (True, np.bool_(False), 2, np.float32(0.5), np.array([7]))
    assert [events.number(value) for value in good] == [True, 0, 2, 0.5, 7]


@pytest.mark.parametrize("number", [0, 12])
def test_an_episode_says_what_its_last_info_holds(number):
    evaluator = Evaluator("probes:Cases-v0", episodes=13, events=("stops", "crashed", "phase", "nothing"))
    episode = evaluator.run(policy_for("probes:Cases-v0"))[number]
    crashed, stops = story(number)
    assert episode.events == {"stops": stops, "crashed": crashed, "phase": None, "nothing": None}
    assert list(episode.events) == ["stops", "crashed", "phase", "nothing"]
    assert type(episode.events["crashed"]) is bool
    assert episode.success == (not crashed)


@pytest.fixture(scope="module")
def cases(tmp_path_factory):
    """A run with an event that there is and one that there is not: (the run, the lines that it showed)."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(StringIO()) as shown:
        patch.syspath_prepend(SUPPORT)
        folder = tmp_path_factory.mktemp("cases")
        names = ["crashed", "stops", "nothing", "stops"]
        run = train(TINY, "probes:Cases-v0", steps=40, directory=folder / "run", events=names, **SHORT)
    return run, shown.getvalue().splitlines()


def test_events_are_columns_after_success(cases):
    run, _ = cases
    lines = (run.runs[0].path / "evaluations.csv").read_text().splitlines()
    assert lines[0] == "seed,step,episode,return,length,success,crashed,stops,nothing"
    expected = []
    for step in (20, 40):
        for number in range(2):
            crashed, stops = story(number)
            expected.append(f"0,{step},{number},3.0,3,{float(not crashed)},{int(crashed)},{stops},")
    assert lines[1:] == expected


def test_events_are_curves_of_tensorboard(cases):
    found = scalars(cases[0].runs[0].path / "tensorboard")
    mean = (story(0)[1] + story(1)[1]) / 2
    assert found["eval/stops"] == [(20, mean), (40, mean)]
    assert {"eval/crashed", "eval/success_rate"} <= found.keys()
    assert "eval/nothing" not in found


class Terms(Endless):
    """Says the step and its square in every `info`, but for the square in the fifth step."""

    def step(self, action):
        observation, reward, terminated, truncated, _ = super().step(action)
        info = {"step_of_10": self.steps, "square": "no number" if self.steps == 5 else self.steps**2}
        return observation, reward, terminated, truncated, info

    def get_snapshot(self):
        return {}, {"steps": self.steps}

    def set_snapshot(self, arrays, values):
        self.steps = values["steps"]


EXPECTED = {"step_of_10": 10, "step_of_10:sum": 55, "square:sum": 385 - 25, "square:mean": 36.0, "none:sum": None}


def test_events_of_training_episodes_are_last_values_sums_or_means(tmp_path):
    settings = {**SHORT, "events": tuple(EXPECTED), "checkpoint_interval": 44, "environments": 2}
    train(TINY, Terms, steps=44, directory=tmp_path / "run", **settings)
    settings |= {"environment_processes": 2}
    run = train(TINY, Terms, steps=80, directory=tmp_path / "run", resume=True, **settings).runs[0]
    names = tuple(name for name in EXPECTED)
    for rows, count in ((run.rows("episodes"), 8), (run.evaluations[-1:], 1)):
        assert len(rows) == count
        expected = np.array([np.nan if value is None else value for value in EXPECTED.values()], float)
        np.testing.assert_array_equal(np.array(rows[list(names)].tolist()), np.tile(expected, (count, 1)))
    curves = scalars(run.path / "tensorboard")
    assert curves["rollout/square:mean"][-1] == (80, 36.0)
    assert "rollout/none:sum" not in curves


def test_a_name_that_nobody_says_is_noted_once(cases):
    run, shown = cases
    (note,) = [line for line in shown if "called 'nothing'" in line]
    assert (run.runs[0].path / "log.txt").read_text().count(note) == 1


def test_events_stay_in_a_fork(cases, tmp_path):
    forked = train(TINY, "probes:Cases-v0", steps=60, directory=tmp_path / "fork", start_from=cases[0].path, **SHORT)
    assert forked.evaluations.dtype.names == cases[0].evaluations.dtype.names
    assert forked.config.events == ("crashed", "stops", "nothing")
    with pytest.raises(InputError, match="stops"):
        train(TINY, "probes:Cases-v0", steps=80, directory=tmp_path / "fork", events=[], resume=True, **SHORT)


def test_evaluate_counts_cases_per_thousand(tmp_path, capsys):
    run_of_task(tmp_path / "run", "probes:Cases-v0", ("crashed", "stops", "nothing"), seeds=(3, 4))
    assert main(["evaluate", str(tmp_path / "run"), "--episodes", "40", "--processes", "1"]) == 0
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines()]
    crashed, stops = np.array([story(number, FRESH_EVALUATION_SEED) for number in range(40)], float).mean(axis=0)
    # The same episodes for both seeds, so the deviation over seeds is 0.
    assert f"crashed {1000 * crashed:.1f} {1000 * crashed:.1f} {1000 * crashed:.1f} ± 0.0" in lines
    assert f"stops (mean) {stops:.3f} {stops:.3f} {stops:.3f} ± 0.000" in lines


class Wandering(Endless):
    """Changes the working directory in each reset."""

    def first_observation(self):
        os.chdir("/")
        return super().first_observation()


@pytest.mark.parametrize("line", ["evaluate run --processes 1 --csv place.csv", "export run --out place.csv"])
def test_paths_are_those_of_where_the_command_was_typed(tmp_path, monkeypatch, line):
    monkeypatch.setitem(gymnasium.registry, "Wandering-v0", EnvSpec("Wandering-v0", lambda **_: Wandering()))
    monkeypatch.chdir(tmp_path)
    run_of_task(Path("run"), "Wandering-v0")
    assert main([*line.split(), "--episodes", "1"]) == 0
    assert (tmp_path / "place.csv").exists()


def test_evaluate_writes_its_episodes_where_nothing_is(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run_of_task(Path("run"), "probes:Cases-v0", events=("crashed", "stops"), seeds=(0, 3))
    assert main(["evaluate", "run", "--episodes", "3", "--csv", "cases.csv"]) == 0
    assert capsys.readouterr().out.endswith("cases.csv\n")
    rows = read_rows("cases.csv")
    assert rows.dtype.names == ("seed", "step", "episode", "return", "length", "success", "crashed", "stops")
    results = dict(evaluate_run("run", episodes=3))
    expected = [(seed, 9, *episode[:4], *episode.events.values()) for seed in (0, 3) for episode in results[seed]]
    assert rows.tolist() == expected
    before = Path("cases.csv").read_bytes()
    for name in ("cases.csv", "none/cases.csv", "cases.csv/x.csv", "."):
        assert main(["evaluate", "run", "--csv", name]) == 2
        assert capsys.readouterr().err.count("\n") == 1
    assert Path("cases.csv").read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cases.csv", "run"]


def test_the_example_of_the_documentation_runs(tmp_path, capsys):
    example = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "own_task.py"))
    example["main"](tmp_path / "run", 600)
    run = RunDirectory.open(tmp_path / "run" / "seed-0")
    assert (run.evaluations.dtype.names or ())[-3:] == ("success", "off_the_rail", "reversals")
    assert not run.manifest.restarts_episode
    assert "\nsuccess " in capsys.readouterr().out
