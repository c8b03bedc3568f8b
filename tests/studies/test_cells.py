import dataclasses

import pytest
from studying import cell, make_run

from csac.studies.cells import Cell, Store, complete, is_final, write_history
from csac.types import InputError

OTHERS = {
    "task": "Walker2d-v4",
    "algorithm": "csac",
    "hyperparameters": {"batch_size": 9},
    "steps": 301,
    "seed": 1,
    "evaluation_interval": 50,
    "evaluation_episodes": 3,
    "perturbations": ("friction=2@100",),
    "environment_arguments": {"healthy_reward": 2.0},
    "events": ("fell",),
}


def test_every_field_is_part_of_the_name():
    assert set(OTHERS) == {field.name for field in dataclasses.fields(Cell)}
    cells = [cell(), *(cell(**{name: value}) for name, value in OTHERS.items())]
    assert len({one.key for one in cells}) == len({one.name for one in cells}) == len(OTHERS) + 1


def test_seeds_of_one_arm_lie_side_by_side():
    first, second = cell(0), cell(1)
    assert first.name.parent == second.name.parent
    assert (first.name.name, second.name.name) == ("seed-0", "seed-1")


@pytest.mark.parametrize(
    "changes",
    [
        {"hyperparameters": {"discount": 0.99}},
        {"hyperparameters": {"actor_hidden_sizes": [8, 8]}},
        {"perturbations": []},
        {"environment_arguments": {}},
    ],
)
def test_equal_cells_share_their_name_however_they_are_written(changes):
    assert cell(**changes).name == cell().name
    assert cell(**changes).key == cell().key


def test_whole_numbers_and_fractions_are_equal_where_a_fraction_is_meant():
    names = {cell(algorithm="csac", hyperparameters={"relative_entropy_weight": tau}).name for tau in (5, 5.0)}
    assert len(names) == 1
    perturbed = {cell(perturbations=(text,)).name for text in ("friction=2@100", "friction=2.0@1e2")}
    assert len(perturbed) == 1


def test_the_name_tells_what_is_not_default():
    paper = Cell.make(
        "Walker2d-v4",
        "csac",
        {"relative_entropy_weight": 5, "reference_policy": "periodic"},
        steps=100_000,
        seed=3,
        evaluation_interval=5_000,
        evaluation_episodes=10,
        perturbations=("friction=1.5@30000",),
    )
    task, arm, seed = paper.name.parts
    assert (task, seed) == ("Walker2d-v4", "seed-3")
    assert arm.rpartition("-")[0] == "csac-relative_entropy_weight=5-periodic-friction=1.5@30000-100k"


def test_what_a_manifest_says_is_the_cell_again(tmp_path):
    store = Store(tmp_path)
    one = cell(perturbations=("friction=2@100",), hyperparameters={"entropy_weight": 0.1})
    run = make_run(store, one)
    assert Cell.of_run(run.manifest) == one


def test_a_run_of_before_there_was_a_hyperparameter_is_found(tmp_path):
    one = cell()
    run = make_run(Store(tmp_path), one)
    older = dict(one.hyperparameters)
    assert older.pop("update_interval") == 1
    run.update_manifest(hyperparameters=older, state="finished", steps_done=300)
    run.path.parent.rename(run.path.parent.with_name("sac-of-an-older-version"))
    store = Store(tmp_path)
    assert store.status(one).state == "complete"
    assert store.path(one).parent.name == "sac-of-an-older-version"
    assert store.status(cell(hyperparameters={"update_interval": 2})).state == "waiting"


def test_states(tmp_path):
    store = Store(tmp_path)
    waiting, partial, done, diverged, crashed, busy = (cell(seed) for seed in range(6))
    make_run(store, partial, steps_done=120)
    make_run(store, done, steps_done=300, state="finished")
    make_run(store, diverged, steps_done=200, state="failed", failures={3: "step 200: critic is not finite"})
    make_run(store, crashed, steps_done=100)
    write_history(store.path(crashed), {"seconds": 12.5, "failure": "its process was killed by SIGKILL"})
    states = {one.seed: store.status(one) for one in (waiting, partial, done, diverged, crashed)}
    assert [status.state for status in states.values()] == ["waiting", "partial", "complete", "failed", "failed"]
    assert [status.steps for status in states.values()] == [0, 120, 300, 200, 100]
    assert states[3].reason == "step 200: critic is not finite"
    assert (states[4].reason, states[4].seconds) == ("its process was killed by SIGKILL", 12.5)
    assert [is_final(store.path(one)) for one in (waiting, partial, done, diverged, crashed)] == [False] * 2 + [
        True
    ] * 2 + [False]
    with make_run(store, busy, steps_done=100).locked():
        assert store.status(busy).state == "running"
    assert store.status(busy).state == "partial"


def test_a_killed_run_goes_on_from_its_newest_checkpoint(tmp_path):
    store = Store(tmp_path)
    waiting, early, killed, done = (cell(seed) for seed in range(4))
    make_run(store, early, steps_done=120)
    make_run(store, killed, steps_done=250, last_checkpoint=200)
    make_run(store, done, steps_done=300, last_checkpoint=200, state="finished")
    assert [store.first_step(one) for one in (waiting, early, killed, done)] == [0, 0, 200, 300]


def test_a_broken_manifest_is_a_failure_that_is_told(tmp_path):
    store = Store(tmp_path)
    (make_run(store, cell()).path / "manifest.json").write_text("{")
    status = store.status(cell())
    assert status.state == "failed"
    assert "is broken" in status.reason


@pytest.mark.parametrize(
    ("algorithm", "given", "message"),
    [
        ("sca", {}, "no algorithm is called 'sca'; did you mean sac?"),
        ("sac", {"bach_size": 8}, "sac has no hyperparameter 'bach_size'; did you mean batch_size?"),
        ("sac", {"discount": 2.0}, "discount must be at least 0 and less than 1"),
    ],
)
def test_mistakes_in_hyperparameters_are_told(algorithm, given, message):
    with pytest.raises(InputError) as raised:
        complete(algorithm, given)
    assert message in str(raised.value)
