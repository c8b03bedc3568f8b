"""Which policy of a run is loaded: by its label, by its evaluations, and never one that has failed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from artefacts import leave
from manifests import make_set
from policies import contract, random_policy

from csac.deploy.choosing import load
from csac.deploy.guards import make_guards
from csac.deploy.policy import Policy
from csac.record.sets import RunSet
from csac.types import InputError


def save_run(
    directory: Path, evaluations: str = "", seeds=(0, 1, 2), failures: dict[int, str] | None = None
) -> dict[int, Policy]:
    runs = make_set(directory, seeds, failures, task="Task-v0", algorithm="csac", steps=9)
    policies = {seed: random_policy(contract(), seed) for seed in seeds}
    for run in runs.runs:
        policies[run.seed].write(run.policy_file())
        random_policy(contract(), run.seed + 100).write(run.policy_file("best"))
        lines = [line for line in evaluations.splitlines(keepends=True) if line.startswith(f"{run.seed},")]
        if lines:
            run.table("evaluations").write_text("seed,step,episode,return,length,success\n" + "".join(lines))
    return policies


def same(one: Policy, other: Policy) -> bool:
    return bool(one.predict(np.ones(2))[0] == other.predict(np.ones(2))[0])


def test_a_seed_is_loaded_by_its_label(tmp_path):
    policies = save_run(tmp_path / "run")
    assert same(load(tmp_path / "run", seed=2), policies[2])
    assert not same(load(tmp_path / "run", seed=2, which="best"), policies[2])
    assert same(load(tmp_path / "run", seed=2, which="best"), random_policy(contract(), 102))


def test_a_seed_that_was_never_evaluated_has_no_best_policy(tmp_path):
    save_run(tmp_path / "run")
    RunSet.open(tmp_path / "run").run(1).policy_file("best").unlink()
    with pytest.raises(InputError, match="seed-1 has no best policy"):
        load(tmp_path / "run", seed=1, which="best")


def test_the_best_policy_needs_no_last_one(tmp_path):
    save_run(tmp_path / "run", seeds=(0,))
    RunSet.open(tmp_path / "run").run(0).policy_file("last").unlink()
    assert same(load(tmp_path / "run", which="best"), random_policy(contract(), 100))


def test_a_run_of_a_set_is_loaded_by_its_folder(tmp_path):
    policies = save_run(tmp_path / "run")
    assert same(load(tmp_path / "run" / "seed-1"), policies[1])
    assert same(load(RunSet.open(tmp_path / "run"), seed=2), policies[2])


def test_the_best_seed_is_best_over_its_last_three_evaluation_points(tmp_path):
    # Means of the last three points: seed 0: (1 + 1 + 30) / 3; seed 1: (12 + 12 + 12) / 3, its 99 being older;
    # seed 2: (90, its own mean of 60 and 120, then 3 and 0) / 3 = 31.
    returns = {0: [[0], [1], [1], [30]], 1: [[99], [12], [12], [12]], 2: [[0], [60, 120], [3], [0]]}
    lines = [
        f"{seed},{step},{episode},{value},10,"
        for step in range(4)
        for seed, points in returns.items()
        for episode, value in enumerate(points[step])
    ]
    policies = save_run(tmp_path / "run", "\n".join(lines) + "\n")
    assert same(load(tmp_path / "run"), policies[2])


def test_a_line_that_is_still_being_written_does_not_count(tmp_path):
    policies = save_run(tmp_path / "run", "0,1,0,5.0,10,\n1,1,0,6.0,10,\n2,1,0,99")
    assert same(load(tmp_path / "run"), policies[1])


def test_the_first_of_equal_seeds_and_the_only_seed_are_chosen(tmp_path):
    policies = save_run(tmp_path / "tie", "2,1,0,5,10,\n1,1,0,5,10,\n")
    assert same(load(tmp_path / "tie"), policies[1])
    policies = save_run(tmp_path / "one", seeds=[4])
    assert same(load(tmp_path / "one"), policies[4])


def test_load_says_what_is_missing(tmp_path):
    save_run(tmp_path / "run")
    (tmp_path / "empty").mkdir()
    save_run(tmp_path / "young", seeds=[0])
    (tmp_path / "young" / "seed-0" / "policy" / "last.safetensors").unlink()
    with pytest.raises(InputError, match="a run directory is a path such as 'runs/first', not None"):
        load(None)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="does not exist"):
        load(tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds no run"):
        load(tmp_path / "empty")
    with pytest.raises(InputError, match="holds no policies"):
        load(tmp_path / "young")
    for wrong in (7, "0"):
        with pytest.raises(InputError, match=f"{wrong!r}"):
            load(tmp_path / "run", seed=wrong)  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError, match="no evaluations to choose by: give a seed, one of 0, 1, 2"):
        load(tmp_path / "run")
    with pytest.raises(InputError, match="choose 'last' or 'best'"):
        load(tmp_path / "run", which="first")  # pyright: ignore[reportArgumentType]
    (tmp_path / "run" / "seed-0" / "evaluations.csv").write_text("seed,step\n0,x\n")
    with pytest.raises(InputError, match="no table"):
        load(tmp_path / "run")


EVALUATIONS = "0,1,0,5.0,10,\n1,1,0,6.0,10,\n2,1,0,7.0,10,\n"


def test_a_failed_seed_is_not_chosen(tmp_path):
    policies = save_run(tmp_path, EVALUATIONS, failures={2: "step 1: reward is nan"})
    assert same(load(tmp_path), policies[1])
    assert same(load(tmp_path, seed=2), policies[2])


def test_where_every_seed_failed_none_is_chosen(tmp_path):
    policies = save_run(tmp_path, EVALUATIONS, failures={seed: f"step {seed}: reward is nan" for seed in range(3)})
    with pytest.raises(InputError, match=r"every seed of .* failed \(seed 0 at step 0: reward is nan\)"):
        load(tmp_path)
    assert same(load(tmp_path, seed=1), policies[1])


def test_a_policy_is_saved_and_loaded_in_one_call_each(tmp_path):
    policy = random_policy(contract(), 7)
    policy.save(tmp_path / "kept" / "cheetah")
    files = sorted(path.name for path in (tmp_path / "kept" / "cheetah").iterdir())
    assert files == ["contract.json", "policy.safetensors"]
    again = load(tmp_path / "kept" / "cheetah")
    assert same(again, policy)
    assert again.contract.fields() == policy.contract.fields()
    random_policy(contract(), 8).save(tmp_path / "kept" / "cheetah")
    assert same(load(str(tmp_path / "kept" / "cheetah")), random_policy(contract(), 8))


def test_a_saved_policy_has_no_seeds_and_replaces_no_run(tmp_path):
    policies = save_run(tmp_path / "run")
    policies[0].save(tmp_path / "kept")
    with pytest.raises(InputError, match="holds one policy and no run: leave out seed and which"):
        load(tmp_path / "kept", seed=0)
    with pytest.raises(InputError, match="holds one policy and no run: leave out seed and which"):
        load(tmp_path / "kept", which="best")
    with pytest.raises(InputError, match="holds a run or an artefact: choose another folder"):
        policies[0].save(tmp_path / "run" / "seed-0")
    with pytest.raises(InputError, match="the folder of a policy is a path such as 'runs/first', not None"):
        policies[0].save(None)  # pyright: ignore[reportArgumentType]
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot write"):
        policies[0].save(tmp_path / "file")


def test_an_artefact_with_guards_is_not_loaded_without_them(tmp_path):
    policy = random_policy(contract(), 3)
    leave(tmp_path / "guarded", policy, "numpy", make_guards(policy.contract, fallback="zero"))
    with pytest.raises(InputError, match="is an artefact with guards"):
        load(tmp_path / "guarded")


def test_a_flipped_bit_and_the_policy_of_another_run_are_refused(tmp_path):
    save_run(tmp_path / "run", EVALUATIONS)
    mine, other = (RunSet.open(tmp_path / "run").run(seed) for seed in (2, 1))
    content = mine.policy_file().read_bytes()
    for wrong in (content[:-1] + bytes([content[-1] ^ 1]), other.policy_file().read_bytes()):
        mine.policy_file().write_bytes(wrong)
        with pytest.raises(InputError, match=r"last\.safetensors does not match its checksum in contract\.json"):
            load(tmp_path / "run")
