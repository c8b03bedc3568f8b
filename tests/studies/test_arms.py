"""Which runs belong together, and what they are called."""

import dataclasses

import pytest
from studying import tiny_study, write_run

from csac.algorithms import ALGORITHMS
from csac.cli import main
from csac.presets import hyperparameters
from csac.record.config import RunConfig
from csac.record.manifest import Origin
from csac.studies.arms import gather, name_of, read_arms, seconds_per_step, train_command
from csac.types import InputError


def config(algorithm="sac", preset=None, seed=0, task="Ant-v4", steps=1_000, perturbations=(), **changes):
    values = hyperparameters(preset, algorithm, task) if preset else {}
    made = ALGORITHMS[algorithm](**{**values, **changes})
    return RunConfig(
        task=task,
        algorithm=algorithm,
        hyperparameters=dataclasses.asdict(made),
        seed=seed,
        steps=steps,
        perturbations=perturbations,
    )


def labels(*paths, **options):
    return [(arm.label, arm.task, [run.seed for run in arm.runs]) for arm in read_arms(paths, **options)]


def test_runs_that_differ_by_their_seeds_are_one_arm(tmp_path):
    for folder in ("first", "second"):
        for seed in (0, 1):
            more = 2 * (folder == "second")
            write_run(tmp_path / folder / f"seed-{seed + more}", config(seed=seed + more))
    write_run(tmp_path / "td3", config("td3"))
    assert labels(tmp_path) == [("SAC", "Ant-v4", [0, 1, 2, 3]), ("TD3 (paper)", "Ant-v4", [0])]
    assert labels(tmp_path / "first", tmp_path) == labels(tmp_path)
    assert labels(tmp_path / "first" / "seed-1") == [("SAC", "Ant-v4", [1])]


def test_a_run_is_called_by_its_preset_and_what_was_fitted():
    assert name_of(config(preset="strong")) == "SAC (strong)"
    assert name_of(config(preset="strong", warmup_steps=1_000)) == "SAC (strong), warmup_steps 1,000"
    assert name_of(config(discount=0.9)) == "SAC"


def test_arms_of_one_name_are_told_apart_by_what_differs_on_every_task(tmp_path):
    write_run(tmp_path / "a", config(discount=0.9))
    write_run(tmp_path / "b", config(discount=0.95))
    write_run(tmp_path / "c", config(discount=0.9, task="Hopper-v4"))
    write_run(tmp_path / "d", config(discount=0.9, steps=2_000, task="Hopper-v4"))
    assert [label for label, *_ in labels(tmp_path)] == [
        "SAC, discount 0.9, steps 1,000",
        "SAC, discount 0.95, steps 1,000",
        "SAC, discount 0.9, steps 1,000",
        "SAC, discount 0.9, steps 2,000",
    ]


def test_other_hyperparameters_on_another_task_are_another_method(tmp_path):
    write_run(tmp_path / "a", config(discount=0.9))
    write_run(tmp_path / "b", config(discount=0.95, task="Hopper-v4"))
    assert [label for label, *_ in labels(tmp_path)] == ["SAC, discount 0.9", "SAC, discount 0.95"]


def test_the_same_seed_twice_is_told_apart_by_its_place(tmp_path):
    write_run(tmp_path / "a" / "seed-0", config())
    write_run(tmp_path / "b" / "seed-0", config())
    assert [label for label, *_ in labels(tmp_path)] == [f"SAC, {tmp_path / name}" for name in "ab"]


def test_a_folder_with_a_seed_twice_keeps_its_others(tmp_path):
    one, two = tmp_path / "one", tmp_path / "two"
    for path in (one / "seed-0", two / "seed-0", two / "seed-1"):
        write_run(path, config(seed=int(path.name[-1])))
    arms = read_arms([one, two])
    assert [[run.path for run in arm.runs] for arm in arms] == [[one / "seed-0"], [two / "seed-0", two / "seed-1"]]


def test_labels_of_ones_own(tmp_path):
    for seed, folder in enumerate("abc"):
        write_run(tmp_path / folder, config(seed=seed, discount=0.9 + seed / 100))
    given = [("ours", [tmp_path / "a", tmp_path / "b"])]
    assert labels(tmp_path, labelled=given) == [("ours", "Ant-v4", [0, 1]), ("SAC", "Ant-v4", [2])]
    with pytest.raises(InputError, match=r"ours: .*a is a second run of seed 0"):
        read_arms([], [("ours", [tmp_path / "a", tmp_path / "a"])])


def test_what_failed_or_is_behind_is_in_no_number(tmp_path):
    write_run(tmp_path / "seed-0", config(seed=0))
    write_run(tmp_path / "seed-1", config(seed=1), state="failed")
    write_run(tmp_path / "seed-2", config(seed=2), state="interrupted", points=4)
    (arm,) = read_arms([tmp_path])
    assert set(arm.rows["seed"]) == {0}
    assert (arm.failures, arm.incomplete) == ({1: "step 5: reward is not finite"}, {2: 400})
    (early,) = read_arms([tmp_path], until=400)
    assert set(early.rows["seed"]) == {0, 2}


def test_seeds_that_a_callback_ended_early_count(tmp_path):
    write_run(tmp_path / "seed-0", config(seed=0))
    write_run(tmp_path / "seed-1", config(seed=1), points=4)
    (arm,) = read_arms([tmp_path])
    assert (set(arm.rows["seed"]), arm.incomplete) == ({0, 1}, {})


def test_forks_are_an_arm_of_their_own(tmp_path):
    write_run(tmp_path / "a" / "seed-0", config(seed=0))
    forked = write_run(tmp_path / "b" / "seed-1", config(seed=1))
    forked.update_manifest(forked_from=Origin("c/seed-1", 900, ("discount is 0.9, not 0.99",)))
    again = write_run(tmp_path / "b" / "seed-2", config(seed=2))
    again.update_manifest(forked_from=Origin("b/seed-1", 1_000, (), ("discount is 0.9, not 0.99",)))
    assert [seeds for *_, seeds in labels(tmp_path)] == [[0], [1], [2]]


def test_a_study_knows_its_seeds_that_have_not_begun(tmp_path):
    study = tiny_study(tmp_path)
    first = study.runs()[0]
    write_run(tmp_path / first.folder, first.config)
    sac, csac = gather(study, tmp_path)
    assert (sac.label, sac.incomplete, len(csac.runs), csac.missing) == ("sac", {1: 0}, 0, [0, 1])
    with pytest.raises(InputError, match="evaluation_interval"):
        gather(tiny_study(tmp_path, evaluation_interval=250), tmp_path)


@pytest.mark.parametrize(
    ("one", "words"),
    [
        (config(preset="strong", warmup_steps=500), "--preset strong --warmup-steps 500"),
        (config(discount=0.9, normalise_observations=True), "--normalise-observations --discount 0.9"),
        (config(critic_hidden_sizes=(32, 16)), "--critic-hidden-sizes 32 16"),
        (config(perturbations=("friction=2@300",)), "--perturb friction=2@300"),
        (dataclasses.replace(config(), evaluation_environments=0), "--evaluation-environments 0"),
    ],
)
def test_the_command_trains_the_same_again(one, words, monkeypatch):
    given = {}
    command = train_command(one, [3, 4, 5])
    assert set(words.split()) <= set(command.split())

    def train(algorithm, task, *, seeds, first_seed, **options):
        given.update(options, algorithm=algorithm, task=task, seeds=(first_seed, seeds))
        raise InputError("enough")

    monkeypatch.setattr("csac.training.train.train", train)
    assert main(command.split()[1:]) == 2
    assert dataclasses.asdict(given["algorithm"]) | {} == {
        name: tuple(value) if isinstance(value, list) else value for name, value in one.hyperparameters.items()
    }
    assert (given["task"], given["seeds"], given["steps"]) == ("Ant-v4", (3, 3), 1_000)
    assert tuple(given["perturbations"] or ()) == one.perturbations


def test_the_pace_of_a_run_leaves_its_stops_out(tmp_path):
    run = write_run(tmp_path / "seed-0", config())
    moments = ["00:00:10", "00:00:20", "09:00:00", "09:00:10", "09:00:20"]
    lines = [f"2026-01-01T{at}+00:00 step {100 * i}: mean return 1.0" for i, at in enumerate(moments, start=1)]
    (run.path / "log.txt").write_text("\n".join([*lines, "2026-01-01T10:00:00+00:00 the end"]))
    assert seconds_per_step(run) == 0.1
    (run.path / "log.txt").unlink()
    assert seconds_per_step(run) is None
