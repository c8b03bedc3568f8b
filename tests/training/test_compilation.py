"""Compiled programs are kept from run to run, change no number, and keep nobody from training."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from csac.algorithms import CSAC
from csac.tasks.vector import Steps
from csac.training import compilation
from csac.training.learner import Learner
from csac.types import Spec

HERE = Path(__file__).parent
SETTINGS: Any = jax.config
TINY: dict[str, Any] = {"actor_hidden_sizes": (8,), "critic_hidden_sizes": (8,)}
CHOICES = ("JAX_COMPILATION_CACHE_DIR", "JAX_ENABLE_COMPILATION_CACHE")


def learn() -> None:
    """Print what a learner learns in a few updates, and how many of its programs came from disk."""
    events: list[str] = []
    jax.monitoring.register_event_listener(lambda event, **_: events.append(event))
    learner = Learner(CSAC(batch_size=8, warmup_steps=3, **TINY), Spec(3, 1), [7], 100)
    observation, action = np.ones((1, 3), np.float32), np.zeros((1, 1), np.float32)
    ends = np.zeros(1, bool)
    donated = []
    for step in range(1, 11):
        before = learner._carry
        outcome = Steps(observation * step, np.ones(1, np.float32), ends, ends, observation * step, [], [])
        action = learner.step(observation * (step - 1), action, outcome, step)
        donated.append(all(buffer.is_deleted() for buffer in jax.tree.leaves(before)))
    bits = b"".join(np.asarray(buffer).tobytes() for buffer in jax.tree.leaves(learner._carry))
    loaded = events.count("/jax/compilation_cache/cache_hits")
    print(json.dumps({"bits": hashlib.sha256(bits).hexdigest(), "loaded": loaded, "donated": donated}))


def learnt(home: Path, **settings: str) -> dict[str, Any]:
    """Return what `learn` prints in a process of its own."""
    surroundings = {name: value for name, value in os.environ.items() if name not in CHOICES}
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", "import test_compilation; test_compilation.learn()"],
        cwd=HERE,
        env={**surroundings, "XDG_CACHE_HOME": str(home), **settings},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    return json.loads(done.stdout)


def kept(home: Path) -> list[Path]:
    return sorted(home.rglob("*-cache"))


@pytest.mark.slow
def test_programs_are_kept_and_change_no_bit(tmp_path):
    without = learnt(tmp_path / "none", JAX_ENABLE_COMPILATION_CACHE="0")
    assert not (tmp_path / "none").exists()

    first = learnt(tmp_path / "home")
    programs = kept(tmp_path / "home")
    second = learnt(tmp_path / "home")

    assert first["loaded"] == 0
    assert 2 <= len(programs) == second["loaded"]
    assert {*kept(tmp_path / "home")} >= {*programs}  # a slow compilation may keep a small one more
    assert without["bits"] == first["bits"] == second["bits"]
    assert all(without["donated"] + first["donated"] + second["donated"])


def test_each_number_of_cores_has_its_own_programs(tmp_path, choices, monkeypatch):
    folders = set()
    for cores in (1, 2):
        monkeypatch.setattr(compilation, "threads_in_use", lambda cores=cores: cores)
        compilation.keep_programs()
        folders.add(SETTINGS.jax_compilation_cache_dir)

    assert len(folders) == 2
    assert {Path(folder).parent for folder in folders} == {tmp_path / "csac" / "programs"}


def test_a_home_that_cannot_be_written_keeps_nobody_from_training(tmp_path, choices):
    (tmp_path / "csac").write_text("no folder")

    compilation.tidy_programs()
    compilation.keep_programs()

    assert SETTINGS.jax_compilation_cache_dir is None


@pytest.mark.parametrize(("size", "left"), [(2, []), (3, ["0-cache", "1-cache", "2-cache"])])
def test_programs_that_are_too_much_are_removed(tmp_path, choices, monkeypatch, size, left):
    folder = tmp_path / "csac" / "programs" / "some-2"
    folder.mkdir(parents=True)
    for number in range(3):
        (folder / f"{number}-cache").write_bytes(b"a program")
    monkeypatch.setattr(compilation, "MOST_BYTES", size * len(b"a program"))

    compilation.tidy_programs()

    assert [entry.name for entry in kept(tmp_path)] == left


def test_the_users_own_choice_comes_first(tmp_path, choices):
    own = str(tmp_path / "own")
    jax.config.update("jax_compilation_cache_dir", own)

    compilation.tidy_programs()
    compilation.keep_programs()

    assert SETTINGS.jax_compilation_cache_dir == own
    assert not (tmp_path / "csac").exists()


@pytest.fixture
def choices(tmp_path, monkeypatch):
    """Leave the choice of a folder to csac, below `tmp_path`, and afterwards everything as it was."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name in CHOICES:
        monkeypatch.setenv(name, "")  # so that it is restored
        monkeypatch.delenv(name)
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    jax.config.update("jax_compilation_cache_dir", None)
    yield
    for name, value in before.items():
        jax.config.update(name, value)
