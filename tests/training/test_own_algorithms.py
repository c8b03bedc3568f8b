"""The algorithms that two pages of docs/ show, from modules outside the package: trained, resumed, exported."""

from __future__ import annotations

import importlib
import json
import re
import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import pytest
from resuming import SMALL, Crash, contents, crash_at, run

import csac.cli
from csac import InputError
from csac.algorithms import SAC
from csac.record.run import RunDirectory
from csac.tasks import trust
from csac.training.config import algorithm_of
from csac.training.program import can_be_sent
from csac.types import Spec

ROOT = Path(__file__).parents[2]
PAGES = "".join((ROOT / "docs" / f"{page}.md").read_text() for page in ("adding-an-algorithm", "learning-options"))
EXAMPLES = {name: (ROOT / "examples" / f"{name}.py").read_text() for name in ("reinforce", "residual")}
MODULES = {**dict(re.findall(r"^```python\n# (\w+)\.py\n(.*?)^```$", PAGES, re.DOTALL | re.MULTILINE)), **EXAMPLES}
OPTIONS = shlex.split(
    "--actor-hidden-sizes 8 8 --critic-hidden-sizes 8 8 --batch-size 8 --warmup-steps 40 --replay-size 150 "
    "--effort-weight 0.5 --steps 200 --evaluation-interval 100 --evaluation-episodes 2"
)
BROKEN = """
from dataclasses import dataclass
from csac.algorithms import SAC

@dataclass(frozen=True)
class Half:
    cadence: int = 0
    def update(self): ...

@dataclass(frozen=True, kw_only=True)
class Required(Half):
    width: int

@dataclass
class Melting:
    def update(self): ...

@dataclass(frozen=True)
class Several(SAC):
    seeds: int = 1
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The modules of pages and examples in a folder, where Python looks, each with a line that tells of its import."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    folder, marker = tmp_path / "modules", tmp_path / "imported"
    folder.mkdir()
    for name, code in MODULES.items():
        (folder / f"{name}.py").write_text(f"{code}\n\nopen({str(marker)!r}, 'w').close()\n")
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(str(folder))
    calm, reinforce, residual = map(importlib.import_module, MODULES)
    yield SimpleNamespace(
        folder=folder,
        marker=marker,
        calm=calm.CalmSAC(effort_weight=0.5, **SMALL),
        reinforce=reinforce.Reinforce(rollout_steps=50),
        residual=residual.ResidualSAC(**SMALL),
    )
    for name in (*MODULES, "broken"):
        sys.modules.pop(name, None)


def command(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "csac", *words], cwd=folder, capture_output=True, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(MODULES))
def test_one_is_trained_killed_resumed_evaluated_and_exported(tmp_path, own, name):
    algorithm = getattr(own, name)
    whole = run(tmp_path / "whole", algorithm).runs[0]
    with pytest.raises(Crash):
        run(tmp_path / "again", algorithm, on_evaluation=crash_at(300))
    again = csac.resume(tmp_path / "again", progress=False).runs[0]
    assert contents(again) == contents(whole)
    assert again.config.algorithm == f"{name}:{type(algorithm).__name__}"
    assert algorithm_of(again.config) == algorithm
    assert csac.load(again).contract.algorithm == again.config.algorithm
    assert csac.load_checkpoint(again.path).algorithm == algorithm
    own.marker.unlink()
    lines = ["evaluate {} --episodes 2", "export {} --episodes 2", "report {} --out page.html"]
    code = "import sys; from csac.cli import main; sys.exit(max(main(line.split()) for line in sys.argv[1:]))"
    words = [sys.executable, "-c", code, *(line.format(again.path) for line in lines)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert not own.marker.exists()


def test_its_loss_is_that_of_sac_and_what_the_action_costs(own):
    plain, key, spec = SAC(**SMALL), jax.random.key(0), Spec(3, 2)
    state = plain.init(key, spec, 100)
    given = state.actor, jnp.ones(3), jnp.zeros(2)
    fixed: dict[str, Any] = {"critics": state.critics, "temperature": jnp.ones(())}
    effort = 0.5 * jnp.sum(plain.act(state, given[1], key, explore=False) ** 2)
    difference = own.calm.actor_loss(*given, **fixed)[0] - plain.actor_loss(*given, **fixed)[0]
    assert float(difference) == pytest.approx(float(effort), rel=1e-4)


@pytest.mark.slow
def test_seeds_train_in_processes_and_from_the_command_line(tmp_path, own):
    seeds = ["--seeds", "2", "--directory", str(tmp_path / "typed")]
    done = command(own.folder, "train", "Hopper-v4", "--algorithm", "calm:CalmSAC", *OPTIONS, *seeds)
    assert done.returncode == 0, done.stderr
    (called,) = run(tmp_path / "called", own.calm, 200, first_seed=1).runs
    assert contents(RunDirectory.open(tmp_path / "typed" / "seed-1")) == contents(called)


@pytest.mark.slow
def test_a_strangers_algorithm_is_not_imported(tmp_path, own, monkeypatch):
    stopped = run(tmp_path / "run", own.calm, 200).runs[0].path
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "another"))
    own.marker.unlink()
    done = command(own.folder, "resume", str(stopped), "--steps", "300")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert f"wants to run the code of the module calm in {own.folder / 'calm.py'}" in done.stderr
    done = command(own.folder, "train", "Hopper-v4", "--from", str(stopped))
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert "add --algorithm calm:CalmSAC" in done.stderr
    assert not own.marker.exists()
    done = command(own.folder, "resume", str(stopped), "--steps", "300", "--trust-task")
    assert done.returncode == 0, done.stderr
    assert own.marker.exists()
    trust.refuse_untrusted("calm:CalmSAC", "run")  # from now on it does not ask


def test_one_that_no_module_can_give_is_resumed_with_the_class_given(tmp_path, own):
    class Local(type(own.calm)): ...

    local = Local(**SMALL)
    assert not can_be_sent(local)
    with pytest.raises(Crash):
        run(tmp_path / "run", local, seeds=2, on_evaluation=crash_at(300))
    with pytest.raises(InputError, match=r"Local: call csac\.train with the algorithm and resume=True"):
        csac.resume(tmp_path / "run")
    assert run(tmp_path / "run", local, seeds=2, resume=True).runs[0].manifest.steps_done == 500
    with pytest.raises(InputError, match="the algorithm cannot be sent to another process"):
        run(tmp_path / "two", local, seeds=2, seeds_per_process=1)


def test_an_exception_in_it_fails_the_run_also_in_this_process(tmp_path):
    class Faulty(SAC):
        def actor_loss(self, *_: Any, **__: Any) -> Any:
            raise ValueError("my mistake")

    runs = run(tmp_path / "run", Faulty(**SMALL), 100)
    assert runs.failures[0] == "step 0: ValueError: my mistake"
    assert "in actor_loss" in (runs.run(0).path / "log.txt").read_text()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("calm:Nothing", "the module calm has no algorithm Nothing"),
        ("calm:policy_at", "the module calm has no algorithm policy_at"),
        ("reinforce:State", "the module reinforce has no algorithm State"),
        ("broken:Half", "Half has no memory or init or act or policy"),
        ("broken:Melting", "Melting must be a frozen dataclass"),
        ("broken:Required", "width of broken:Required has no default"),
        ("broken:Several", "--seeds of broken:Several"),
        ("nowhere:SAC", "the module nowhere cannot be imported"),
        ("calm", "no algorithm is called 'calm': choose csac or sac"),
    ],
)
def test_what_is_no_algorithm_is_told_in_one_line(own, monkeypatch, capsys, name, message):
    (own.folder / "broken.py").write_text(BROKEN)
    monkeypatch.chdir(own.folder)
    assert csac.cli.main(["train", "Pendulum-v1", "--algorithm", name]) == 2
    told = capsys.readouterr().err
    assert (told.count("\n"), message in told) == (1, True), told


def test_a_metric_that_would_be_a_column_twice_is_refused(tmp_path):
    class Counting(SAC):
        def update(self, state, batch, key, step):
            state, metrics = super().update(state, batch, key, step)
            return state, {**metrics, "step": metrics["critic_loss"]}

    with pytest.raises(InputError, match="metric called 'step'"):
        run(tmp_path / "run", Counting(**SMALL))


def test_what_a_manifest_cannot_keep_is_refused(tmp_path, own):
    odd = replace(own.reinforce, std=own.calm)
    with pytest.raises(InputError, match="std of Reinforce cannot be kept in a manifest"):
        run(tmp_path / "run", odd)


def test_a_manifest_that_was_changed_is_told(tmp_path, own):
    stopped = run(tmp_path / "run", own.reinforce, 200).runs[0]
    manifest = stopped.path / "manifest.json"
    fields = json.loads(manifest.read_text())
    fields["config"]["hyperparameters"]["colour"] = 1
    manifest.write_text(json.dumps(fields))
    with pytest.raises(InputError, match="unknown hyperparameters: colour"):
        csac.resume(stopped.path, steps=300)
