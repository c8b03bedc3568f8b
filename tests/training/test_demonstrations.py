"""Transitions of one's own are what a replay begins with; what is none of the task's is refused in one line."""

from __future__ import annotations

import runpy
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from probes import IdEncoded
from resuming import SMALL, Crash, contents, crash_at, run
from typed import csac as typed

import csac
from csac import InputError
from csac.algorithms import SAC, TD3
from csac.algorithms.memory import Replay
from csac.record.run import RunDirectory
from csac.types import Spec

TASK = "Pendulum-v1"  # three observations, one action within ±2
EXACT = "InvertedPendulum-v4"  # four observations, one action within ±3; an episode in progress goes on


def arrays(number: int = 30, size: int = 3) -> dict[str, Any]:
    """Transitions whose numbers say which they are."""
    k = np.arange(number, dtype=np.float64)
    observations = k[:, None] + 0.25 * np.arange(size)
    return {
        "observations": observations,
        "actions": np.linspace(-2, 2, number)[:, None],
        "rewards": -k,
        "next_observations": observations + 1,
        "terminations": k % 5 == 4,
    }


def test_any_number_of_rows_is_written_over_the_oldest_wherever_they_begin():
    replay = Replay(jnp.zeros((5, 5)))
    story: list[int] = []
    for number, count in ((3, 0), (4, 3), (0, 7), (8, 7)):  # of eight rows the newest five are left
        new = [*range(len(story), len(story) + number)]
        rows = np.full((8, 5), -1.0, np.float32)
        rows[:number] = np.array(new, np.float32).reshape(-1, 1)
        replay, story = (
            jax.jit(Replay.extend)(replay, jnp.asarray(rows), jnp.int32(number), jnp.int32(count)),
            story + new,
        )
        held = {i % 5: float(i) for i in story}
        assert replay.rows[:, 0].tolist() == [held.get(place, 0.0) for place in range(5)]
    drawn = replay.sample(jax.random.key(0), jnp.int32(15), 200, Spec(1, 1))
    assert sorted(set(drawn.reward.tolist())) == [10, 11, 12, 13, 14]


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"algorithm": SAC(update_interval=7, n_steps=3, **SMALL)},
        {"environments": 4, "seeds": 2, "seeds_per_process": 2},
    ],
    ids=["alone", "n-step", "several"],
)
def test_they_come_first_in_the_replay_and_survive_a_crash(tmp_path, settings):
    given = {"algorithm": TD3(**{**SMALL, "replay_size": 120}), "task": EXACT, "steps": 240, **settings}
    given |= {"demonstrations": arrays(size=4), "checkpoint_interval": 60, "evaluation_interval": 60}
    whole = run(tmp_path / "whole", keep_checkpoints=0, **given)
    early = csac.load_checkpoint(whole, step=60).replay()
    for name, array in arrays(size=4).items():
        found = early["terminated" if name == "terminations" else name][:30]
        np.testing.assert_allclose(found, array, atol=1e-6, err_msg=name)
    assert len(early["rewards"]) == 30 + 60 - 60 % given["algorithm"].cadence.update_interval
    with pytest.raises(Crash):
        run(tmp_path / "again", on_evaluation=crash_at(180), **given)
    again = csac.resume(tmp_path / "again", progress=False)
    assert [contents(one) for one in again.runs] == [contents(one) for one in whole.runs]
    assert all(one.manifest.history[-1].exact for one in again.runs)


@pytest.mark.slow
def test_a_run_that_was_stopped_before_its_first_checkpoint_still_has_them(tmp_path):
    given: dict[str, Any] = {"task": EXACT, "steps": 100, "evaluation_interval": 50, "demonstrations": arrays(size=4)}
    whole = run(tmp_path / "whole", **given)
    with pytest.raises(Crash):
        run(tmp_path / "again", on_evaluation=crash_at(50), **given)
    shutil.copytree(tmp_path / "again", tmp_path / "damaged")
    assert contents(csac.resume(tmp_path / "again", progress=False).runs[0]) == contents(whole.runs[0])
    path = tmp_path / "damaged" / "seed-0" / "checkpoint" / "replay" / "0-30.safetensors"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(InputError, match=r"0-30\.safetensors is missing or has changed"):
        csac.resume(tmp_path / "damaged", progress=False)


def test_what_is_learnt_depends_on_them_and_the_manifest_tells_of_them(tmp_path):
    np.savez(tmp_path / "pendulum.npz", allow_pickle=False, **arrays())
    given: dict[str, Any] = {"algorithm": SAC(**SMALL), "task": TASK, "steps": 100}
    without, with_them = (
        run(tmp_path / name, demonstrations=file, **given)
        for name, file in (("a", None), ("b", str(tmp_path / "pendulum.npz")))
    )
    assert contents(without.runs[0])["metrics.csv"] != contents(with_them.runs[0])["metrics.csv"]
    told = with_them.config.demonstrations
    assert (told["source"], told["transitions"], len(told["sha256"])) == ("pendulum.npz", 30, 64)
    assert without.config.demonstrations == {}
    with pytest.raises(InputError, match=r"demonstrations\.transitions is 30, not 29"):
        run(tmp_path / "b", resume=True, demonstrations=arrays(29), **given)


@pytest.mark.slow
def test_the_replay_of_a_run_is_taken_and_a_fork_keeps_what_its_run_began_with(tmp_path):
    first = run(tmp_path / "first", SAC(**SMALL), 100, task=IdEncoded)
    replay = csac.load_checkpoint(first).replay()
    second = run(tmp_path / "second", SAC(**SMALL), 50, task=IdEncoded, demonstrations=replay)
    held = csac.load_checkpoint(second).replay()
    for name, array in replay.items():
        np.testing.assert_allclose(held[name][:100], array, atol=1e-6, err_msg=name)
    fork: dict[str, Any] = {"task": IdEncoded, "start_from": second.path, "steps": 100}
    made = run(tmp_path / "fork", SAC(**SMALL), **fork)
    assert made.config.demonstrations == second.config.demonstrations
    assert len(csac.load_checkpoint(made).replay()["rewards"]) == 150  # replay_size: the oldest 50 are gone
    run(tmp_path / "fork", SAC(**SMALL), resume=True, **fork)
    with pytest.raises(InputError, match="a fork has the replay"):
        run(tmp_path / "other", SAC(**SMALL), demonstrations=replay, **fork)


def test_a_minari_data_set_is_read_or_what_to_install_is_told(tmp_path, monkeypatch):
    with pytest.raises(InputError, match=r"'pendulum/mine-v0' .*pip install"):
        run(tmp_path / "run", SAC(**SMALL), 50, task=TASK, demonstrations="pendulum/mine-v0")
    seen = np.arange(12.0).reshape(4, 3)  # one more than there are actions
    episode = SimpleNamespace(
        observations=seen, actions=np.zeros((3, 1)), rewards=np.arange(3), terminations=[0, 0, 1], truncations=[0] * 3
    )
    data = SimpleNamespace(iterate_episodes=lambda: iter([episode, episode]))
    monkeypatch.setitem(sys.modules, "minari", SimpleNamespace(load_dataset=lambda name, download: data))
    made = run(tmp_path / "run", SAC(**SMALL), 50, task=TASK, demonstrations="pendulum/mine-v0")
    held = csac.load_checkpoint(made).replay()
    np.testing.assert_array_equal(held["observations"][:6], [*seen[:3], *seen[:3]])
    np.testing.assert_array_equal(held["next_observations"][:6], [*seen[1:], *seen[1:]])
    assert held["terminated"][:6].tolist() == [False, False, True] * 2
    assert made.config.demonstrations["source"] == "pendulum/mine-v0"


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"observations": np.zeros((30, 4))}, "observations: .*(30, 4)"),
        ({"next_observations": np.zeros((29, 3))}, r"next_observations has shape \(29, 3\), not \(30, 3\)"),
        ({"actions": np.zeros((30, 2))}, "actions has shape"),
        ({"actions": np.full((30, 1), 3.0)}, "actions are at 1.5 times the task's bounds"),
        ({"rewards": np.full(30, np.nan)}, "rewards holds what is not finite"),
        ({"rewards": np.full(30, 1e300)}, "rewards holds what is not finite"),
        ({"rewards": np.full(30, "one")}, "rewards: could not convert string to float"),
        ({"rewards": np.zeros(0)}, "no transitions"),
        ({"rewards": np.array(1.0)}, "no transitions"),
        ({"terminations": np.full(30, 0.5)}, "are 0 or 1"),
        ({"truncations": np.zeros(3)}, "truncations has shape"),
        ({"truncation": np.zeros(30)}, "did you mean truncations"),
        ({"terminations": None}, "lacks terminations: it has observations, actions"),
    ],
)
def test_what_is_none_of_the_task_is_refused(tmp_path, changes, told):
    given = {name: array for name, array in {**arrays(), **changes}.items() if array is not None}
    with pytest.raises(InputError, match=told) as error:
        run(tmp_path / "run", SAC(**SMALL), 50, task=TASK, demonstrations=given)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ("--algorithm ppo --demonstrations good.npz", "demonstrations are for algorithms with a replay"),
        ("--demonstrations missing.npz", "demonstrations: cannot read missing.npz: No such file"),
        ("--demonstrations text.npz", "demonstrations: text.npz is no .npz file"),
        ("--demonstrations objects.npz", "demonstrations: objects.npz is no .npz file"),
        ("--demonstrations one.npz", "demonstrations: one.npz is no .npz file"),
        ("--replay-size 20 --batch-size 8 --demonstrations good.npz", "demonstrations has 30 transitions"),
    ],
)
def test_a_bad_file_is_one_line_on_the_command_line(tmp_path, monkeypatch, capsys, options, told):
    monkeypatch.chdir(tmp_path)
    np.savez("good.npz", allow_pickle=False, **arrays())
    np.savez("objects.npz", allow_pickle=True, **arrays() | {"rewards": np.array([None] * 30)})
    (tmp_path / "text.npz").write_text("rewards\n")
    with open("one.npz", "wb") as file:
        np.save(file, np.zeros(3))
    assert typed(f"train {TASK} --steps 50 --directory run {options}") == 2
    error = capsys.readouterr().err
    assert (error.count("\n"), told in error) == (1, True), error
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_the_example_of_the_documentation_runs(tmp_path, capsys):
    example = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "demonstrations.py"))
    example["main"](tmp_path / "run", 40, 1)
    assert "\nwith, every 8 steps: " in capsys.readouterr().out
    assert RunDirectory.open(tmp_path / "run" / "with" / "seed-0").config.demonstrations["transitions"] > 50
