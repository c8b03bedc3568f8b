"""What is wrong with the arguments is told in one line, and nothing is written."""

from __future__ import annotations

import pytest
from typed import csac


@pytest.mark.parametrize(
    ("line", "complaint"),
    [
        ("trian X", "no command is called 'trian'; did you mean train? (csac --help)"),
        ("train", "TASK is missing (csac train --help)"),
        ("train X --steps", "--steps needs a value (csac train --help)"),
        ("train X --steps abc", "--steps: 'abc' is not a number (csac train --help)"),
        ("train X --steps 1.5", "--steps: '1.5' is not a whole number (csac train --help)"),
        ("train X --seeds inf", "--seeds: 'inf' is not a whole number (csac train --help)"),
        ("train X --groups x", "--groups: 'x' is not a number (csac train --help)"),
        ("train X --discount x", "--discount: 'x' is not a number (csac train --help)"),
        ("train X --sedes 3", "there is no option --sedes; did you mean --seeds or --steps? (csac train --help)"),
        (
            "train X --tau 1",
            "there is no option --tau; it is --relative-entropy-weight or --target-rate here (csac train --help)",
        ),
        ("train X --algorithm td3 --sigma 1", "there is no option --sigma (csac train --help)"),
        ("runs --all", "there is no option --all (csac runs --help)"),
        ("evaluate --foo X", "there is no option --foo (csac evaluate --help)"),
        ("study show --foo", "there is no option --foo (csac study show --help)"),
        (
            "report X --title -foo",
            "--title needs a value; one that begins with a dash is written --title=-foo (csac report --help)",
        ),
        ("report -- -nowhere", "-nowhere does not exist; give a run directory ('csac runs' lists them)"),
        ("train X --foo 3 --steps abc", "there is no option --foo (csac train --help)"),
        (
            "train X --directory-of run",
            "there is no option --directory-of; did you mean --directory? (csac train --help)",
        ),
        ("train X --dir run", "there is no option --dir; did you mean --directory? (csac train --help)"),
        (
            "train --steps 9 --actor-hidden-sizes 8 8 X --seeds 1",
            "TASK is missing: --actor-hidden-sizes took X, so write it before the options (csac train --help)",
        ),
        ("train os:Qxyz-v0", "no task is called os:Qxyz-v0: os registers none of that name"),
        ("train X --form DIR", "there is no option --form; did you mean --from? (csac train --help)"),
        ("evaluate X --runs 1", "there is no option --runs (csac evaluate --help)"),
        (
            "study run smoke --engine x",
            "--engine: 'x' is not one of 'local', 'processes', 'ray' (csac study run --help)",
        ),
        ("latency nowhere", "nowhere is not an artefact: give a folder that csac export has written"),
        ("train X --no_such_thing=3", "there is no option --no-such-thing (csac train --help)"),
        ("train X Y", "there is no place for 'Y': one task a run; several: csac study (csac train --help)"),
        ("train X --algorithm SAC", "no algorithm is called 'SAC'; did you mean sac?"),
        (
            "resume X --discount 0.9",
            "a run keeps its hyperparameters: begin another with csac train TASK --from DIR --discount X "
            "(csac resume --help)",
        ),
        ("help nonsense", "no command is called 'nonsense' (csac --help)"),
        ("train X --device tpu", "--device: 'tpu' is not one of 'cpu', 'gpu' (csac train --help)"),
        ("train X --algorithm dqn", "no algorithm is called 'dqn': choose csac or sac or td3 or sd3 or ppo"),
        ("train X --preset papr", "no preset is called 'papr': choose paper or strong"),
        (
            "train X --trace-decay 1",
            "--trace-decay is an option of ppo, which --algorithm ppo chooses (csac train --help)",
        ),
        ("train X --actor-hidden-sizes 3 x", "--actor-hidden-sizes does not take ['3', 'x'] (csac train --help)"),
        ("train X --env-kwargs [1]", "--env-kwargs takes a JSON object such as '{\"name\": 1.5}', not [1]"),
        ("train X --discount 1.5", "discount must be at least 0 and less than 1, not 1.5 (csac train --help)"),
        ("train Qxyz-v0", "no task is called Qxyz-v0: write module:Id for one that a module registers"),
        ("train probes:Endless-v0 --seeds 0", "seeds must be a whole number of at least 1, not 0 (csac train --help)"),
        ("train X --first-seed 1e20", "first_seed must be at most 4,294,967,295, not 1e+20 (csac train --help)"),
        ("train X --seeds 1e9", "seeds must be at most 10,000, not 1e+09 (csac train --help)"),
        ("train Hopper-v4 --perturb", "--perturb needs a value (csac train --help)"),
        (
            "train Hopper-v4 --perturb frction=2",
            "no perturbation is called 'frction': there are friction, gravity, mass, gain, "
            "observation_noise, action_noise",
        ),
        (
            "train Hopper-v4 --steps 100 --perturb gain=2@100",
            "gain=2@100 would change nothing: the run ends at step 100; give an earlier step",
        ),
        (
            "train probes:Endless-v0 --perturb mass=2",
            "probes:Endless-v0 is no MuJoCo task: of it only observation_noise and action_noise can be perturbed",
        ),
        ("train X --perturb none --perturb mass=2", "--perturb none leaves everything out: give it alone"),
        ("evaluate", "DIR is missing (csac evaluate --help)"),
        ("evaluate nowhere", "nowhere does not exist; give a run directory ('csac runs' lists them)"),
        (
            "evaluate nowhere --episode 3",
            "there is no option --episode; did you mean --episodes? (csac evaluate --help)",
        ),
        (
            "evaluate X --deterministic",
            "there is no option --deterministic; it is the default, without --stochastic, here (csac evaluate --help)",
        ),
        (
            "train X --directory=",
            "--directory was given an empty value, which would be the folder that you are in: write . for that "
            "(csac train --help)",
        ),
        (
            "train --directory= X",
            "--directory was given an empty value, which would be the folder that you are in: write . for that "
            "(csac train --help)",
        ),
        ("play nowhere", "nowhere does not exist; give a run directory ('csac runs' lists them)"),
        ("runs nowhere", "there is no directory nowhere; give one that holds runs"),
    ],
)
def test_a_mistake_is_one_line_and_leaves_no_trace(capsys, tmp_path, line, complaint):
    assert csac(line) == 2

    output = capsys.readouterr()
    assert output.err == f"csac: {complaint}\n"
    assert output.out == ""
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ("X --lr 1e-3", "there is no option --lr; it is --actor-learning-rate and --critic-learning-rate here"),
        ("X --algorithm ppo --lr 1e-3", "there is no option --lr; it is --learning-rate here"),
        (
            "X --net-arch 64 64",
            "there is no option --net-arch; it is --actor-hidden-sizes and --critic-hidden-sizes here",
        ),
        ("X --eval-freq 5", "there is no option --eval-freq; it is --evaluation-interval here"),
        ("X --n_eval_episodes=5", "there is no option --n-eval-episodes; it is --evaluation-episodes here"),
        ("X --track", "there is no option --track; it is --wandb here"),
        ("X --n-envs 4", "there is no option --n-envs; each seed has one environment, and --seeds says how many"),
        ("X --num-envs 4", "there is no option --num-envs; each seed has one environment, and --seeds says how many"),
        ("X --gpu", "there is no option --gpu; it is --device gpu here"),
        ("X --rho 0.01", "there is no option --rho; it is --target-rate here"),
        ("X --verbose 1", "there is no option --verbose; none is needed"),
        ("--env X", "there is no option --env; the task has no flag: csac train Pendulum-v1"),
        ("--task X", "there is no option --task; the task has no flag: csac train Pendulum-v1"),
        (
            "X --algorithm td3 --learning-rate 1",
            "there is no option --learning-rate; it is --actor-learning-rate and --critic-learning-rate here",
        ),
        (
            "X --hidden-sizes 8",
            "there is no option --hidden-sizes; it is --actor-hidden-sizes and --critic-hidden-sizes here",
        ),
        (
            "X --algorithm ppo --critic-learning-rate 1",
            "there is no option --critic-learning-rate; it is --learning-rate here",
        ),
        (
            "X --algorithm ppo --batch-size 8",
            "there is no option --batch-size; it is --minibatches (their number) here",
        ),
        (
            "X --algorithm ppo --actor-hidden-sizes 8",
            "there is no option --actor-hidden-sizes; it is --hidden-sizes here",
        ),
        (
            "X --algorithm sac --ent-coef auto",
            "there is no option --ent-coef; it is --entropy-weight here",
        ),
        ("X --reference-policy previous", "write --reference-policy average --reference-rate 1"),
        ("X --reference-policy algorithm1", "write --reference-policy periodic --reference-period 1"),
        ("X --entropy-weight automatic", "write --entropy-weight auto"),
        ("X --relative-entropy-weight automatically", "write --relative-entropy-weight auto"),
        ("X --seed 3", "there is no option --seed; it is --first-seed here"),
        ("X --wandb my-project", "there is no place for 'my-project': --wandb takes no value"),
        (
            "X --algorithm ppo --warmup-steps 9",
            "--warmup-steps is an option of csac, sac, td3 and sd3, which --algorithm chooses",
        ),
        (
            "X --algorithm sac --temperature 0.2",
            "there is no option --temperature; it is --entropy-weight (a number, or auto) here",
        ),
        ("X --actor-hidden-sizes --steps 5", "--actor-hidden-sizes needs at least one number, as 256 256"),
        ("X --algorithm ppo --hidden_sizes", "--hidden-sizes needs at least one number, as 256 256"),
        ("X --actor-hidden-sizes 400,300", "write the numbers with blanks between: --actor-hidden-sizes 400 300"),
        ("X --actor-hidden-sizes=[400,300]", "write the numbers with blanks between: --actor-hidden-sizes 400 300"),
        ("X --actor-hidden-sizes 400, 300", "write the numbers with blanks between: --actor-hidden-sizes 400 300"),
        ("X --seeds 0,1,2", "--seeds is how many: --seeds 3"),
        ("X --seeds 0 1 2", "--seeds is how many: --seeds 3"),
        (
            "X --perturb friction=2@9 mass=2@9",
            "write --perturb before each: --perturb friction=2@9 --perturb mass=2@9",
        ),
        ("X --device cuda:0", "--device takes cpu or gpu (cuda is gpu here)"),
        ("X --wandb True", "--wandb takes no value; without it, it is off"),
        (
            "X --normalise-observations=false",
            "--normalise-observations takes no value; --no-normalise-observations turns it off",
        ),
    ],
)
def test_what_other_libraries_write_leads_to_what_is_written_here(capsys, options, complaint):
    assert csac(f"train {options}") == 2
    assert capsys.readouterr().err == f"csac: {complaint} (csac train --help)\n"


def test_a_video_is_not_called_out(capsys):
    assert csac("play X --out film.mp4") == 2
    assert capsys.readouterr().err == "csac: there is no option --out; it is --video here (csac play --help)\n"


def test_json_that_is_none_is_told_where(capsys):
    assert csac("train X --env-kwargs {a") == 2

    complaint = capsys.readouterr().err
    assert complaint.startswith("csac: --env-kwargs is not JSON (Expecting property name")
    assert complaint.count("\n") == 1


def test_a_long_word_in_a_complaint_stays_whole(capsys):
    word = "x" * 300

    csac(f"train X --steps {word}")

    assert word in capsys.readouterr().err
