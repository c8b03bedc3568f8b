"""What is wrong with the arguments is told in one line, and nothing is written."""

from __future__ import annotations

import pytest
from typed import csac


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("trian X", "did you mean train?"),
        ("train", "TASK is missing"),
        ("train X --steps", "'--steps'"),
        ("train X --steps abc", "--steps: could not convert string to float: 'abc'"),
        ("train X --steps 1.5", "--steps: "),
        ("train X --discount 1.5", "discount must be"),
        ("train X --first-seed 1e20", "first_seed must be at most"),
        ("train X --steps 0", "steps must be"),
        ("train X --sedes 3", "--seeds"),
        ("train X --no_such_thing=3", "--no-such-thing"),
        ("train X --tau 1", "--relative-entropy-weight"),
        ("train X --gamma 1", "it is --discount here"),
        ("train X --learning-rate 1", "it is --actor-learning-rate and --critic-learning-rate here"),
        ("train X --environment-arguments {}", "it is --env-kwargs here"),
        ("train X --seed 3", "it is --first-seed here"),
        ("train X --algorithm ppo --warmup-steps 9", "--algorithm csac or sac or td3 or sd3 has it"),
        ("train X --clip-range 0.1", "--algorithm ppo has it"),
        ("train X --actor-hidden-sizes 400,300", "--actor-hidden-sizes"),
        ("train X --critic-hidden-sizes --seeds 1", "--critic-hidden-sizes"),
        ("train X Y", "there is no Y here"),
        ("train X --wandb True", "there is no True here"),
        ("train X --device tpu", "'tpu'"),
        ("train X --algorithm SAC", "did you mean sac?"),
        ("train X --algorithm dqn", "csac or sac or td3 or sd3 or ppo"),
        ("train X --preset papr", "'papr'"),
        ("train X --env-kwargs {a", "--env-kwargs"),
        ("train X --perturb none --perturb mass=2", "--perturb none"),
        ("train X --resume", "directory"),
        ("train X --from nowhere", "nowhere does not exist"),
        ("train Qxyz-v0", "Qxyz-v0"),
        ("train os:Qxyz-v0", "os:Qxyz-v0"),
        ("train Hopper-v4 --perturb frction=2", "frction"),
        ("train Hopper-v4 --steps 100 --perturb gain=2@100", "gain=2@100"),
        ("train probes:Endless-v0 --perturb mass=2", "probes:Endless-v0 is no MuJoCo task"),
        ("train probes:Endless-v0 --seeds 0", "seeds must be"),
        ("resume X --discount 0.9", "--discount"),
        ("resume nowhere", "nowhere does not exist"),
        ("evaluate", "DIR is missing"),
        ("evaluate nowhere", "nowhere does not exist"),
        ("play X --vidoe a.mp4", "--video"),
        ("latency nowhere", "nowhere"),
        ("runs nowhere", "nowhere"),
        ("report nowhere", "nowhere"),
        ("study shwo", "did you mean show?"),
        ("study run smoke --engine x", "'x'"),
        ("tune X --trails 3", "--trials"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_no_trace(capsys, tmp_path, line, told):
    assert csac(line) == 2
    output = capsys.readouterr()
    assert output.err.startswith("csac: ")
    assert told in output.err
    assert (output.err.count("\n"), output.out) == (1, "")
    assert list(tmp_path.iterdir()) == []


def test_a_long_word_stays_whole(capsys):
    word = "x" * 300
    csac(f"train X --steps {word}")
    assert word in capsys.readouterr().err
