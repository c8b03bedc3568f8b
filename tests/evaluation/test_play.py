"""A run's policies again: how far it is, episodes that never end, whose module is imported."""

from __future__ import annotations

from typing import Any

import gymnasium
import imageio_ffmpeg
import numpy as np
import pytest
from gymnasium import spaces
from policies import contract, random_policy

from csac.evaluation import play as playing
from csac.evaluation.play import evaluate_run, play
from csac.record.manifest import Manifest
from csac.record.run import RunDirectory

# JAX may be loaded here; where csac plays, it is not.
pytestmark = pytest.mark.filterwarnings(
    "ignore:os.fork:RuntimeWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)


class Stripes(gymnasium.Env):
    """It never ends by itself, and can be drawn."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
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
        return np.zeros(2, np.float32), 1.0, False, False, {}

    def render(self):
        return np.full((32, 32, 3), 9 * self.steps % 256, np.uint8)


@pytest.fixture
def run_of(tmp_path):
    def make(steps: int | None) -> RunDirectory:
        task = f"Stripes-v{steps or 0}"
        if task not in gymnasium.registry:
            gymnasium.register(task, entry_point=f"{__name__}:Stripes", max_episode_steps=steps)
        run = RunDirectory.create(tmp_path / "run", Manifest(task=task, algorithm="csac", seeds=(0,), steps=9))
        run.contract.parent.mkdir()
        contract().save(run.contract)
        random_policy(contract()).save_layers(run.policy(0))
        return run

    return make


def test_play_tells_how_far_it_is(run_of, tmp_path):
    told = []
    film = tmp_path / "film.mp4"
    episodes = list(play(run_of(7).path, episodes=2, video=film, on_progress=lambda done, of: told.append((done, of))))
    assert [episode.length for episode in episodes] == [7, 7]
    assert told == [(done, 14) for done in range(1, 15)]
    frames, _ = imageio_ffmpeg.count_frames_and_secs(str(film))
    assert frames == 2 * 10  # eight pictures, on the screen for a second


def test_play_breaks_off_an_episode_that_never_ends(run_of, tmp_path, monkeypatch):
    monkeypatch.setattr(playing, "LONGEST_EPISODE", 5)
    told = []
    (episode,) = play(
        run_of(None).path, video=tmp_path / "film.mp4", on_progress=lambda done, of: told.append((done, of))
    )
    assert episode.length == 5
    assert told[-1] == (5, 5)


def test_evaluating_a_run_tells_how_far_it_is(run_of):
    told = []
    results = dict(evaluate_run(run_of(3).path, episodes=12, processes=1, on_progress=lambda *done: told.append(done)))
    assert [episode.length for episode in results[0]] == [3] * 12
    assert told == [(10, 12), (12, 12)]
