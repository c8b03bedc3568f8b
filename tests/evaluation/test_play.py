"""A run's policies again: how far it is, episodes that never end, whose module is imported."""

from __future__ import annotations

import runpy
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium
import imageio_ffmpeg
import numpy as np
import pytest
from gymnasium import spaces
from manifests import make_set, manifest
from PIL import Image
from policies import contract, random_policy

from csac.cli import main
from csac.deploy.contract import Contract
from csac.evaluation import play as playing
from csac.evaluation.play import evaluate_run, play
from csac.record.run import RunDirectory
from csac.record.tables import read_rows
from csac.types import InputError

# JAX may be loaded here; where csac plays, it is not.
pytestmark = pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")


ACTIONS: list[list[float]] = []  # that reached the task


class Stripes(gymnasium.Env):
    """It never ends by itself, and can be drawn."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 12.5}  # noqa: RUF012
    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        ACTIONS.append(action.tolist())
        return np.zeros(2, np.float32), 1.0, False, False, {}

    def render(self):
        return np.full((32, 32, 3), 9 * self.steps % 256, np.uint8)


@pytest.fixture
def run_of(tmp_path):
    def make(steps: int | None, agreement: Contract | None = None) -> RunDirectory:
        agreement = agreement or contract()
        task = f"Stripes-v{steps or 0}"
        if task not in gymnasium.registry:
            gymnasium.register(task, entry_point=f"{__name__}:Stripes", max_episode_steps=steps)
        (run,) = make_set(tmp_path / "run", task=task, algorithm="csac", steps=9).runs
        random_policy(agreement).write(run.policy_file())
        return run

    return make


@pytest.mark.parametrize("task", ["HalfCheetah-v4", "Walker2d-v4"])
def test_the_camera_follows_the_body(tmp_path, task):
    with closing(playing._drawn_environment(make_set(tmp_path, task=task), "film.mp4")) as environment:
        renderer = getattr(environment.raw.unwrapped, "mujoco_renderer")  # noqa: B009
        assert renderer.model.camera(renderer.camera_id).name == "track"


def test_play_tells_how_far_it_is(run_of, tmp_path):
    told = []
    film = tmp_path / "film.mp4"
    episodes = list(play(run_of(7).path, episodes=2, video=film, on_progress=lambda done, of: told.append((done, of))))
    assert [episode.length for episode in episodes] == [7, 7]
    assert told == [(done, 14) for done in range(1, 15)]
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(film))
    assert (frames, seconds) == (2 * 12, 24 / 12.5)  # eight pictures, on the screen for a second


def test_the_example_films_runs_side_by_side(run_of, tmp_path):
    run = run_of(30)
    run.append("evaluations", [{"seed": 0, "step": 9, "episode": 0, "return": 30.0, "length": 30, "success": None}])
    film = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "film.py"))["film"]
    film([run.path, run.path], tmp_path / "film.gif", begin=1.0, seconds=0.5)
    with Image.open(tmp_path / "film.gif") as picture:
        assert picture.size == (520, 260)
        picture.seek(9)  # the last at 20 a second


def test_play_breaks_off_an_episode_that_never_ends(run_of, tmp_path, monkeypatch):
    monkeypatch.setattr(playing, "LONGEST_EPISODE", 5)
    told = []
    (episode,) = play(
        run_of(None).path, video=tmp_path / "film.mp4", on_progress=lambda done, of: told.append((done, of))
    )
    assert episode.length == 5
    assert told[-1] == (5, 5)


def test_a_task_whose_spaces_have_changed_is_not_played(run_of, tmp_path):
    with pytest.raises(InputError, match=r"trained on observations \(2,\) and actions \(2,\); Stripes-v3 has"):
        list(play(run_of(3, contract(action_shape=(2,))).path, video=tmp_path / "film.mp4"))
    assert not (tmp_path / "film.mp4").exists()


def test_what_is_played_is_what_is_evaluated(run_of, tmp_path):
    """Both scale by the bounds that the policy was trained with: here the task's have become wider since."""
    run = run_of(3, contract(low=-0.25, high=0.5))
    del ACTIONS[:]
    list(play(run.path, video=tmp_path / "film.mp4"))
    (expected,) = np.unique(ACTIONS)
    del ACTIONS[:]
    list(evaluate_run(run.path, episodes=1, processes=1))
    np.testing.assert_allclose(np.unique(ACTIONS), [expected], rtol=1e-6)
    inside = random_policy(contract(low=-0.25, high=0.5)).act(np.zeros((1, 2), np.float32))[0]
    assert expected == pytest.approx(0.125 + 0.375 * inside[0])


@pytest.mark.parametrize("name", ["x" * 251 + ".mp4", "file/film.mp4", "film.avi"])
def test_a_video_that_cannot_be_is_refused_before_the_episodes(run_of, tmp_path, name):
    """The first has a name that is short enough, but for what is put before it until the video is whole."""
    (tmp_path / "file").touch()
    del ACTIONS[:]
    with pytest.raises(InputError, match=name) as caught:
        list(play(run_of(3).path, video=tmp_path / name))
    assert "\n" not in str(caught.value)
    assert ACTIONS == []


@pytest.mark.parametrize("breaks", [True, False])
def test_an_ffmpeg_that_ends_is_told_in_one_line(run_of, tmp_path, monkeypatch, breaks):
    def write_frames(*_, **__):
        while True:
            if (yield) is not None and breaks:
                raise OSError("[Errno 32] Broken pipe\n\nFFMPEG COMMAND:\nffmpeg -y\n\nFFMPEG STDERR OUTPUT:\n")

    monkeypatch.setattr("imageio_ffmpeg.write_frames", write_frames)
    film = tmp_path / "film.mp4"
    with pytest.raises(InputError) as caught:
        list(play(run_of(3).path, video=film))
    assert str(caught.value) == f"cannot write {film}: ffmpeg failed; choose another place"
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_the_policy_of_the_best_evaluation_can_be_tested_and_watched(run_of, tmp_path, monkeypatch):
    """Its rows are of the step at which it was saved."""
    run = run_of(3)
    best = random_policy(contract(), 5, step=6)
    best.write(run.policy_file("best"))
    run.append("evaluations", [evaluation(step, value) for step, value in ((3, 1.0), (6, 8.0), (9, 2.0))])
    (expected,) = best.contract.to_environment(best.act(np.zeros((1, 2), np.float32)))[0]
    monkeypatch.chdir(tmp_path)
    for line in ("evaluate run --episodes 1 --csv rows.csv", "play run --video film.mp4"):
        del ACTIONS[:]
        assert main([*line.split(), "--trust-task", "--checkpoint", "best"]) == 0
        np.testing.assert_allclose(np.unique(ACTIONS), [expected], rtol=1e-6)
    assert read_rows("rows.csv")["step"].tolist() == [6]


def evaluation(step: int, value: float) -> dict[str, Any]:
    return {"seed": 0, "step": step, "episode": 0, "return": value, "length": 3, "success": None}


def test_evaluating_a_run_tells_how_far_it_is(run_of):
    told = []
    results = dict(evaluate_run(run_of(3).path, episodes=12, processes=1, on_progress=lambda *done: told.append(done)))
    assert [episode.length for episode in results[0]] == [3] * 12
    assert told == [(10, 12), (12, 12)]


def test_the_best_policies_of_a_set_are_those_of_the_seeds_that_were_evaluated(run_of, tmp_path, capsys):
    run = run_of(3)
    with pytest.raises(InputError, match="best"):
        list(evaluate_run(run.path, episodes=1, processes=1, which="best"))
    random_policy(contract()).write(run.policy_file("best"))
    other = RunDirectory.create(tmp_path / "run" / "seed-1", manifest(task=run.config.task, steps=9, seed=1))
    random_policy(contract()).write(other.policy_file())
    places = str(tmp_path / "run")
    assert [seed for seed, _ in evaluate_run(places, episodes=1, processes=1, which="best")] == [0]
    assert main(["evaluate", places, "--checkpoint", "best", "--episodes", "1", "--processes", "1"]) == 0
    assert "seed 1" in capsys.readouterr().out
