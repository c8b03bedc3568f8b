import dataclasses
import inspect
import io
import os
import re
import shlex
import signal
import subprocess
import sys
from dataclasses import asdict, replace
from pathlib import Path

import gymnasium
import imageio_ffmpeg
import numpy as np
import pytest

import csac.evaluation.export as exporting
import csac.evaluation.play as playing
import csac.training.train as training
from csac.algorithms import ALGORITHMS, CSAC, SAC
from csac.arguments import peek
from csac.cli import main
from csac.commands import Chosen
from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.evaluation.export import ExportOptions
from csac.record.csv_tables import read_rows
from csac.record.manifest import EvaluationPlan, Manifest
from csac.record.run import RunDirectory
from csac.training.checkpoint import Checkpoint
from csac.training.plan import algorithm_of
from csac.training.resume import Source
from csac.types import Layer, PolicyNetwork, PolicyParameters

NOTHING = Manifest(task="t", algorithm="csac", seeds=(0,), steps=1)
SUPPORT = Path(__file__).parent / "support"
COMMANDS = ("train", "resume", "evaluate", "play", "export", "latency", "runs", "report", "study", "tune")
TINY = "--batch-size 8 --actor-hidden-sizes 8 --critic-hidden-sizes 8"


def csac(line):
    """Type `csac line` and return the exit code."""
    return main(shlex.split(line))


class Pictures(gymnasium.Env):
    """Five steps of the same reward, and a picture of each."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-2, 2, (1,), np.float32)

    def __init__(self, render_mode=None, reward=1.0):
        self.render_mode, self.reward, self.steps = render_mode, reward, 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(3, np.float32), {}

    def step(self, action):
        self.steps += 1
        return np.zeros(3, np.float32), self.reward, self.steps == 5, False, {}

    def render(self):
        return np.full((34, 48, 3), 40 * self.steps, np.uint8)


if "Pictures-v0" not in gymnasium.registry:
    gymnasium.register("Pictures-v0", entry_point=f"{__name__}:Pictures")


@pytest.fixture(autouse=True)
def _here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(SUPPORT)


@pytest.fixture
def train_call(monkeypatch):
    """What `csac train` calls `train` with, instead of training."""
    calls = []

    def train(algorithm, task, **options):
        calls.append({"algorithm": algorithm, "task": task, **options})
        return RunDirectory(Path("run"), replace(NOTHING, state="finished"))

    monkeypatch.setattr(training, "train", train)

    def call(line):
        assert csac(f"train {line}") == 0
        return calls[-1]

    return call


def calls_of(monkeypatch, module, name, result=()):
    """What a command calls a function with, by the names of its arguments, instead of running it."""
    calls, signature = [], inspect.signature(getattr(module, name))

    def called(*given, **named):
        arguments = signature.bind(*given, **named).arguments
        calls.append({name: value for name, value in arguments.items() if name not in ("reporter", "on_progress")})
        return result

    monkeypatch.setattr(module, name, called)
    return calls


def make_run(path, task, observation_size, low, high, seeds=(0, 1)):
    """A finished run with a random linear policy for each seed."""
    path = Path(path)
    run = RunDirectory.create(
        path, Manifest(task=task, algorithm="csac", seeds=tuple(seeds), steps=100, steps_done=100)
    )
    contract = Contract(
        task=task,
        algorithm="csac",
        activation="relu",
        head="tanh_gaussian",
        observation_parts=((None, (observation_size,)),),
        action_shape=(len(low),),
        action_low=np.array(low, np.float32),
        action_high=np.array(high, np.float32),
    )
    (path / "policy").mkdir()
    contract.save(path / "policy" / "contract.json")
    generator = np.random.default_rng(0)
    for seed in seeds:
        weight = generator.normal(size=(observation_size, 2 * len(low))).astype(np.float32)
        network = PolicyNetwork(PolicyParameters(((Layer(weight, np.zeros(2 * len(low), np.float32)),),)))
        Policy(network, contract).save_layers(path / "policy" / f"seed_{seed}.safetensors")
        rows = {"seed": seed, "step": 100, "episode": 0, "return": float(seed), "length": 5, "success": None}
        run.append("evaluations", [rows])
    run.update_manifest(state="finished")
    return run


def words(text):
    return [" ".join(line.split()) for line in text.splitlines() if line.strip(" ─")]


# What is wrong with the arguments is told in one line, and nothing is written.


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
        ("latency nowhere", "nowhere does not exist; give the folder of an artefact (csac export writes one)"),
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
            "train X --temperature fixed",
            "--temperature is an option of sac, which --algorithm sac chooses (csac train --help)",
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
            "no perturbation is called 'frction': did you mean friction? there are friction, gravity, mass, gain, "
            "observation_noise, action_noise",
        ),
        (
            "train Hopper-v4 --steps 100 --perturb gain=2@100",
            "gain=2@100 would change nothing: the run ends at step 100; give an earlier step",
        ),
        (
            "train probes:Endless-v0 --perturb mass=2",
            "probes:Endless-v0 is no MuJoCo task: friction, gravity, mass, gain cannot be changed, and "
            "observation_noise and action_noise can",
        ),
        ("train X --perturb none --perturb mass=2", "--perturb none leaves everything out: give it alone"),
        ("evaluate", "DIR is missing (csac evaluate --help)"),
        ("evaluate nowhere", "nowhere does not exist; give a run directory ('csac runs' lists them)"),
        (
            "evaluate nowhere --episode 3",
            "there is no option --episode; did you mean --episodes? (csac evaluate --help)",
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
            "there is no option --ent-coef; it is --temperature or --entropy-weight here",
        ),
        ("X --algorithm sac --entropy-weight auto", "the entropy weight adapts with --temperature automatic"),
        ("X --algorithm sac --temperature 0.2", "write --temperature fixed --entropy-weight 0.2"),
        ("X --actor-hidden-sizes --steps 5", "--actor-hidden-sizes needs at least one number, as 256 256"),
        ("X --algorithm ppo --hidden_sizes", "--hidden-sizes needs at least one number, as 256 256"),
        ("X --actor-hidden-sizes 400,300", "write the numbers with blanks between: --actor-hidden-sizes 400 300"),
        ("X --actor-hidden-sizes=[400,300]", "write the numbers with blanks between: --actor-hidden-sizes 400 300"),
        ("X --actor-hidden-sizes 400, 300", "write the numbers with blanks between: --actor-hidden-sizes 400 300"),
        ("X --seeds 0,1,2", "--seeds is how many: --seeds 3"),
        ("X --seeds 0 1 2", "--seeds is how many: --seeds 3"),
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


# What the options mean.


def test_train_passes_its_options_on(train_call):
    call = train_call(
        "Hopper-v4 --steps 1e5 --seeds 3 --first-seed 7 --directory some/where --device gpu --groups 2 "
        "--evaluation-interval 1_000 --evaluation-episodes 4 --evaluation-processes 3 "
        "--checkpoint-interval 5e3 --keep-checkpoints 0 --resume --wandb "
        "--warmup-steps 2e3 --actor-hidden-sizes 8 9 "
        "--perturb friction=1.5@5e4 --perturb=action-noise=0.1 "
        """--env-kwargs '{"ctrl_cost_weight": 0.5}'"""
    )

    assert call["task"] == "Hopper-v4"
    assert call["algorithm"] == CSAC(warmup_steps=2000, actor_hidden_sizes=(8, 9))
    assert call["directory"] == Path("some/where")
    assert call["environment_arguments"] == {"ctrl_cost_weight": 0.5}
    assert call["perturbations"] == ("friction=1.5@5e4", "action-noise=0.1")
    assert call["command"].startswith("csac train Hopper-v4 --steps 1e5")
    assert call["command"].endswith("""--env-kwargs '{"ctrl_cost_weight": 0.5}'""")
    numbers = {name: call[name] for name in call if isinstance(call[name], int)}
    assert numbers == {
        "steps": 100_000,
        "seeds": 3,
        "first_seed": 7,
        "groups": 2,
        "evaluation_interval": 1000,
        "evaluation_episodes": 4,
        "evaluation_processes": 3,
        "checkpoint_interval": 5000,
        "keep_checkpoints": 0,
        "resume": True,
        "wandb": True,
    }
    assert call["start_from"] is None


def test_resume_passes_its_options_on(monkeypatch):
    calls = calls_of(monkeypatch, training, "resume", RunDirectory(Path("run"), replace(NOTHING, state="finished")))
    line = "resume some/run --steps 2e3 --trust-task"
    assert csac(line) == csac("resume some/run") == 0
    told = {"directory": Path("some/run"), "evaluation_processes": None}
    assert calls == [
        {**told, "steps": 2_000, "trust_task": True, "command": f"csac {line}"},
        {**told, "steps": None, "trust_task": False, "command": "csac resume some/run"},
    ]


def test_evaluate_passes_its_options_on(monkeypatch):
    make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    calls = calls_of(monkeypatch, playing, "evaluate_run")
    line = "evaluate run --seed 1 --checkpoint best --episodes 4 --processes 3 --stochastic"
    assert csac(f"{line} --perturb friction=2 --perturb action_noise=0.1 --trust-task") == 0
    assert csac("evaluate run") == 0
    assert calls == [
        {
            "directory": Path("run"),
            "seed": 1,
            "episodes": 4,
            "deterministic": False,
            "perturbations": ("friction=2", "action_noise=0.1"),
            "processes": 3,
            "trust_task": True,
            "which": "best",
        },
        {
            "directory": Path("run"),
            "seed": None,
            "episodes": 10,
            "deterministic": True,
            "perturbations": (),
            "processes": None,
            "trust_task": False,
            "which": "last",
        },
    ]


def test_play_passes_its_options_on(monkeypatch):
    make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    calls = calls_of(monkeypatch, playing, "play")
    line = "play run --seed 1 --checkpoint best --episodes 4 --video film.mp4 --perturb friction=2 --trust-task"
    assert csac(line) == csac("play run") == 0
    assert calls == [
        {
            "directory": Path("run"),
            "seed": 1,
            "episodes": 4,
            "video": Path("film.mp4"),
            "perturbations": ("friction=2",),
            "trust_task": True,
            "which": "best",
        },
        {
            "directory": Path("run"),
            "seed": None,
            "episodes": 1,
            "video": None,
            "perturbations": (),
            "trust_task": False,
            "which": "last",
        },
    ]


def test_export_passes_its_options_on(monkeypatch):
    make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    calls = calls_of(monkeypatch, exporting, "export_run")
    line = "export run --seed 1 --checkpoint best --format 'onnx, c' --out there --weights int8 --stochastic "
    line += "--noise-seed 5 --fallback middle --observation-range recorded --range-margin 0.25 --watchdog 3 "
    line += "--rate-limit 0.1 --episodes 4 --card --trust-task"
    assert csac(line) == csac("export run") == csac("export run --stochastic --no-rollouts") == 0
    told = {"directory": Path("run"), "seed": None, "which": "last", "place": None, "trust_task": False}
    assert calls == [
        {
            "directory": Path("run"),
            "formats": ("onnx", "c"),
            "seed": 1,
            "which": "best",
            "place": Path("there"),
            "options": ExportOptions(5, "int8", "middle", "recorded", 0.25, 3, 0.1, 4, card=True),
            "trust_task": True,
        },
        {**told, "formats": ("numpy",), "options": ExportOptions()},
        {**told, "formats": ("numpy",), "options": ExportOptions(noise_seed=0, episodes=0)},
    ]


def test_train_without_options_uses_the_defaults(train_call):
    call = train_call("Hopper-v4")

    assert call["algorithm"] == CSAC()
    assert (call["steps"], call["seeds"], call["groups"], call["directory"]) == (1_000_000, 1, None, None)
    assert "preset" not in call
    assert (call["resume"], call["start_from"], call["perturbations"]) == (False, None, None)
    assert (call["checkpoint_interval"], call["keep_checkpoints"]) == (50_000, 2)
    assert call["evaluation_processes"] is None


@pytest.mark.parametrize(
    ("options", "perturbations"),
    [
        ("", None),  # as planned there
        ("--perturb mass=2@70", ("mass=2@70",)),
        ("--perturb none", ()),
    ],
)
def test_a_fork_is_perturbed_as_its_source_unless_told_otherwise(train_call, monkeypatch, options, perturbations):
    source = make_run("source", "Hopper-v4", 11, [-1.0] * 3, [1.0] * 3)
    evaluation = EvaluationPlan(10, 1, 3_000_000)
    source.update_manifest(perturbations=["friction=2@60"], evaluation=evaluation, environment_arguments={})
    monkeypatch.setattr(Source, "find", lambda where: Source(source, Checkpoint(Path("none"), 50, {}, {})))

    call = train_call(f"Hopper-v4 --from source@50 {options}")

    assert call["perturbations"] == perturbations
    assert call["start_from"] == "source@50"
    assert call["evaluation_seed"] == 3_000_000  # which no option tells


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_each_algorithm_brings_its_options(train_call, name):
    assert train_call(f"Hopper-v4 --algorithm {name}")["algorithm"] == ALGORITHMS[name]()
    assert train_call(f"Hopper-v4 --algorithm={name} --discount 0.5")["algorithm"].discount == 0.5


def test_a_preset_depends_on_the_task_and_options_win_over_it(train_call):
    quad = "PyFlyt/QuadX-Waypoints-v1"

    assert train_call("Ant-v4 --preset paper")["algorithm"].relative_entropy_weight == 0.5
    assert train_call(f"--preset paper {quad}")["algorithm"].relative_entropy_weight == 0.1
    given = train_call(f"{quad} --preset=paper --relative-entropy-weight 5")
    assert given["algorithm"].relative_entropy_weight == 5.0
    assert given["algorithm"].reference_policy == "algorithm1"


def test_a_preset_is_the_algorithms_own(train_call):
    algorithm = train_call("Ant-v4 --algorithm sac --preset paper")["algorithm"]

    assert algorithm == SAC(temperature="fixed", entropy_weight=0.2)


def test_weights_that_adapt_come_back_from_the_manifest(train_call):
    line = (
        "Hopper-v4 --reference-policy periodic --entropy-weight auto --relative-entropy-weight auto "
        "--target-relative-entropy 0.02"
    )
    algorithm = train_call(line)["algorithm"]
    assert algorithm == CSAC(
        entropy_weight="auto",
        relative_entropy_weight="auto",
        reference_policy="periodic",
        target_relative_entropy=0.02,
    )
    assert train_call("Hopper-v4 --entropy-weight 0.3")["algorithm"] == CSAC(entropy_weight=0.3)

    told = replace(NOTHING, hyperparameters=asdict(algorithm))
    RunDirectory.create(Path("adaptive"), told)
    assert algorithm_of(RunDirectory.open("adaptive").manifest) == algorithm


def test_a_manifest_from_before_csac_had_options_means_what_it_meant():
    newer = {"critic_reference", "relative_entropy_form", "target_log_prob_bound"}
    newer |= {"target_entropy", "target_relative_entropy", "weight_learning_rate"}
    values = {name: value for name, value in asdict(CSAC(entropy_weight=0.3)).items() if name not in newer}
    told = replace(NOTHING, hyperparameters=values)
    explicit = CSAC(
        entropy_weight=0.3, critic_reference="same", relative_entropy_form="explicit", target_log_prob_bound=0.0
    )
    assert algorithm_of(told) == explicit


def test_negative_numbers_are_values(train_call):
    assert train_call("Ant-v4 --algorithm sac --target-entropy -3")["algorithm"].target_entropy == -3.0


@pytest.mark.parametrize(
    ("arguments", "value"), [([], "a"), (["--x", "b"], "b"), (["--x=b", "--x", "c"], "c"), (["--x"], "a"), (["x"], "a")]
)
def test_peeking_finds_the_last_value(arguments, value):
    assert peek(arguments, "--x", "a") == value


# Help.


def test_help_lists_the_commands(capsys):
    assert csac("") == 0
    assert csac("--help") == 0

    output = capsys.readouterr().out
    for command in COMMANDS:
        assert output.count(f"  csac {command} ") == 2


@pytest.mark.parametrize("words", ["train", "study show", "resume"])
def test_help_before_a_command_is_the_help_of_it(capsys, words):
    assert csac(f"help {words}") == 0
    assert capsys.readouterr().out.startswith(f"usage: csac {words} ")


def test_version(capsys):
    assert csac("--version") == 0
    assert capsys.readouterr().out == "csac 0.1.0\n"


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_the_help_of_train_explains_every_hyperparameter(capsys, monkeypatch, name):
    monkeypatch.setenv("COLUMNS", "100")  # wider, and the options stand in two columns

    assert csac(f"train --help --algorithm {name}") == 0

    box = capsys.readouterr().out.partition(f" {name} options")[2]
    shown = re.sub(r", --no-\S+", "", " ".join(line.strip("│ ") for line in box.splitlines()))
    for item in dataclasses.fields(ALGORITHMS[name]):
        option = "--" + item.name.replace("_", "-")
        explanation = shown.partition(f"{option} ")[2].partition(" --")[0]
        assert "(default: " in explanation
        assert len(explanation.partition("(default")[0].split()) > 3


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("train", "mass or gain of a MuJoCo task; standard deviations of observation_noise or action_noise."),
        ("export", "as a share of its range; the fallback is then the last action, unless another is given."),
        ("study run", "one cell per worker at a time. ray: as many as a Ray cluster has room for (docs/cluster.md)."),
        ("study run", "each finished cell to this directory: all that a report needs. Cells copied there"),
    ],
)
def test_a_long_explanation_breaks_off_nowhere(capsys, monkeypatch, command, words):
    monkeypatch.setenv("COLUMNS", "2000")  # tyro would break it where its docstring goes on in another line

    csac(f"{command} --help")

    assert words in capsys.readouterr().out


def test_the_help_shows_what_a_preset_sets(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")

    csac("train --algorithm sac --preset paper --help")

    output = " ".join(capsys.readouterr().out.split())
    assert "(default: fixed)" in output
    assert "(default: paper)" in output


@pytest.mark.parametrize("command", ["train", "tune"])
@pytest.mark.parametrize(("task", "weight"), [("PyFlyt/QuadX-Waypoints-v1", 0.1), ("Hopper-v4", 0.5), ("", 0.5)])
def test_the_help_shows_what_a_preset_sets_for_the_task(capsys, monkeypatch, command, task, weight):
    monkeypatch.setenv("COLUMNS", "200")

    csac(f"{command} {task} --preset paper --help")

    output = " ".join(capsys.readouterr().out.split())
    assert f"(default: {weight})" in output.partition("--relative-entropy-weight ")[2].partition(" --")[0]


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("evaluate", ["--seed", "--episodes", "--stochastic", "--perturb KIND=VALUE"]),
        ("play", ["--seed", "--episodes", "--video", "--perturb KIND=VALUE"]),
    ],
)
def test_the_other_commands_have_help(capsys, command, options):
    assert csac(f"{command} --help") == 0

    output = capsys.readouterr().out
    assert all(option in output for option in [*options, "DIR"])


# The commands themselves.


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run of two seeds, trained by the command line on a task of constant reward: (exit code, its directory)."""
    directory = tmp_path_factory.mktemp("trained") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SUPPORT)
        code = csac(
            f"train probes:Endless-v0 --directory {directory} --steps 40 --warmup-steps 20 --seeds 2 --groups 1 "
            f"--evaluation-interval 20 {TINY}"
        )
    return code, directory


def test_train_writes_a_run(trained):
    code, directory = trained
    run = RunDirectory.open(directory)

    assert code == 0
    assert run.manifest.state == "finished"
    assert (run.manifest.command or "").startswith("csac train probes:Endless-v0 --directory ")
    assert run.manifest.hyperparameters["batch_size"] == 8
    assert len(run.evaluations) == 2 * 2 * 10
    assert set(run.evaluations["return"]) == {10.0}
    there = {path.name for path in directory.rglob("*")}
    assert {"metrics.csv", "episodes.csv", "log.txt", "curve.png", "contract.json", "seed_1.best.safetensors"} <= there
    assert {path.name for path in (directory / "tensorboard").iterdir()} == {"seed_0", "seed_1"}


def test_evaluate_reads_what_train_wrote(trained, capsys):
    assert csac(f"evaluate {trained[1]} --episodes 2") == 0

    assert words(capsys.readouterr().out) == [
        "seed mean return ± std min max length",
        "0 10.00 0.00 10.00 10.00 10.0",
        "1 10.00 0.00 10.00 10.00 10.0",
        "mean 10.00",
        "2 seeds: no interval",
    ]


def test_evaluate_says_what_was_perturbed(trained, capsys):
    perturb = "--perturb observation-noise=0.1 --perturb action_noise=0.2"
    assert csac(f"evaluate {trained[1]} --seed 1 --episodes 1 {perturb}") == 0

    assert words(capsys.readouterr().out) == [
        "perturbed: observation noise 0.1, action noise 0.2",
        "seed mean return ± std min max length",
        "1 10.00 10.00 10.00 10.0",
    ]


@pytest.mark.parametrize(
    ("perturb", "complaint"),
    [
        ("action_noise=0.2@7", "action_noise=0.2@7: nothing is learnt here, so it holds from the beginning: leave out"),
        ("friction=2", "probes:Endless-v0 is no MuJoCo task: friction, gravity, mass, gain cannot be changed"),
    ],
)
def test_evaluate_refuses_what_it_cannot_perturb(trained, capsys, perturb, complaint):
    assert csac(f"evaluate {trained[1]} --perturb {perturb}") == 2

    output = capsys.readouterr()
    assert output.err.startswith(f"csac: {complaint}")
    assert (output.err.count("\n"), output.out) == (1, "")


def test_a_command_works_where_stderr_is_no_file(monkeypatch, capsys):
    monkeypatch.setattr("faulthandler.is_enabled", lambda: False)
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("csac ")


def test_a_test_without_the_perturbations_of_the_training_says_so(capsys):
    run = make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    run.update_manifest(perturbations=["action_noise=0.1@50"])

    assert csac("evaluate run --seed 0 --episodes 1") == 0

    first = capsys.readouterr().out.splitlines()[0]
    assert first == "not perturbed, unlike its training (action_noise=0.1@50): see --perturb"


def test_a_policy_of_the_warm_up_is_told_to_have_never_learnt(capsys):
    note = "note: this policy has never learnt: 100 of 500 warm-up steps are done"
    run = make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    for warmup, told in ((100, False), (500, True)):
        run.update_manifest(hyperparameters={"warmup_steps": warmup})
        assert csac("evaluate run --seed 0 --episodes 1") == 0
        assert (note in capsys.readouterr().out.splitlines()) == told

    assert csac("export run --format 'numpy, c' --no-rollouts") == 0

    assert capsys.readouterr().out.splitlines()[-1] == note
    assert {path.name for path in Path("run/export").iterdir()} == {"numpy", "c"}


def test_a_closed_standard_output_is_no_mistake():
    command = f"{shlex.quote(sys.executable)} -m csac runs >&-"
    process = subprocess.run(["sh", "-c", command], stderr=subprocess.PIPE)
    assert (process.returncode, process.stderr) == (0, b"")


def test_evaluate_takes_one_seed(trained, capsys):
    assert csac(f"evaluate {trained[1]} --seed 1 --episodes 1 --stochastic") == 0

    assert words(capsys.readouterr().out)[1:] == ["1 10.00 10.00 10.00 10.0"]


def test_evaluate_samples_where_it_is_asked_to():
    make_run("run", "probes:ActionReward-v0", 1, [-1.0], [1.0])

    def returns(options, name):
        assert csac(f"evaluate run --seed 0 --episodes 4 --trust-task --csv {name}.csv {options}") == 0
        return read_rows(f"{name}.csv")["return"].tolist()

    assert returns("", "steady") == [-0.25] * 4  # the action 0, where 0.5 were best
    assert len(set(returns("--stochastic", "sampled"))) == 4


def test_evaluate_names_the_seeds_there(trained, capsys):
    assert csac(f"evaluate {trained[1]} --seed 5") == 2

    assert capsys.readouterr().err.endswith("has no policy of seed 5; it has those of 0, 1\n")


def test_train_leaves_a_run_that_is_there_alone(trained, capsys):
    before = {path: path.read_bytes() for path in trained[1].rglob("*") if path.is_file()}

    assert csac(f"train probes:Endless-v0 --directory {trained[1]}") == 2

    assert "already holds a run" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in trained[1].rglob("*") if path.is_file()} == before


def test_runs_lists_it(trained, capsys):
    assert csac(f"runs {trained[1].parent}") == 0

    assert words(capsys.readouterr().out)[1] == f"probes:Endless-v0 csac 2 40 / 40 finished 10.00 {trained[1]}"


def test_runs_tells_of_one_that_is_damaged(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "evaluations.csv").touch()
    (tmp_path / "run" / "manifest.json").write_bytes(b'{"schema_version": 1, "ta')

    assert csac(f"runs {tmp_path}") == 0

    told = capsys.readouterr().out
    assert told.startswith("damaged: ")
    assert "manifest.json is broken" in told


def test_runs_without_any_says_how_to_start_one(capsys):
    assert csac("runs") == 0

    assert capsys.readouterr().out == "no runs in runs yet; csac train HalfCheetah-v4 starts one\n"


def test_a_failed_seed_is_exit_code_3(capsys):
    code = csac(
        """train probes:Failing-v0 --directory run --env-kwargs '{"where": "step", "at": 30}' --steps 50 """
        f"--evaluation-interval 25 --evaluation-episodes 1 {TINY}"
    )

    assert code == 3
    assert "seed 0 failed at step 30: " in capsys.readouterr().out
    assert RunDirectory.open("run").manifest.state == "failed"


def test_an_interrupted_run_says_what_is_not_saved():
    run = RunDirectory(Path("my run"), NOTHING)
    assert str(training.Interrupted(run, signal.SIGINT, True, 9_500)) == (
        "stopped by SIGINT; my run is saved but for its last 9,500 steps"
    )


def test_a_run_that_is_there_needs_no_source_any_more(tmp_path):
    """A scheduler types the same line again; meanwhile the source has trained on, or is gone."""
    run = make_run(tmp_path / "fork", "Hopper-v4", 3, [-1.0], [1.0])
    chosen = Chosen.among(["--from", str(tmp_path / "gone@400"), "--directory", str(run.path), "--resume"])
    assert chosen.source == run.manifest


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_says_what_to_type(monkeypatch, capsys, number, code):
    def train(*_, **__):
        raise training.Interrupted(RunDirectory(Path("my run"), NOTHING), number, is_saved=True)

    monkeypatch.setattr(training, "train", train)

    assert csac("train Hopper-v4") == code
    assert capsys.readouterr().err.endswith("type: csac resume 'my run'\n")


@pytest.mark.parametrize(("given", "code"), [((), 130), ((signal.SIGINT,), 130), ((signal.SIGTERM,), 143)])
def test_leaving_at_once_has_the_exit_code_of_its_signal(monkeypatch, given, code):
    def train(*_, **__):
        raise KeyboardInterrupt(*given)

    monkeypatch.setattr(training, "train", train)
    assert csac("train Hopper-v4") == code


@pytest.mark.parametrize(
    ("number", "groups"), [(signal.SIGTERM, 1), (signal.SIGINT, 2)], ids=["SIGTERM", "SIGINT to every process"]
)
def test_a_signal_saves_what_was_learnt(tmp_path, number, groups):
    """A terminal sends Ctrl-C to all processes of a run; only the first may act on it."""
    line = "train probes:Endless-v0 --directory run --steps 1e8 --warmup-steps 1e8 --replay-size 1e3 "
    line += f"--seeds {groups} --groups {groups} --evaluation-interval 250 {TINY}"
    process = subprocess.Popen(
        [sys.executable, "-m", "csac", *shlex.split(line)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(SUPPORT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("step 250 of 100,000,000: mean return 10.00"):
            os.killpg(process.pid, number)
            break
    output, errors = process.communicate()

    assert process.returncode == 128 + number
    told = f"csac: stopped by {number.name}; saved in run; to go on, type: csac resume run\n"
    assert errors == told
    assert "stopped at step" in output
    assert "failed" not in output
    run = RunDirectory.open(tmp_path / "run")
    assert run.manifest.state == "interrupted"
    assert run.manifest.steps_done >= 250
    assert (run.path / "checkpoint" / f"step_{run.manifest.steps_done}.json").exists()
    assert csac(f"evaluate {run.path} --episodes 1") == 0


def test_too_few_file_handles_are_told_and_the_run_goes_on_with_enough(tmp_path):
    line = f"train Pendulum-v1 --directory run --steps 120 --evaluation-interval 60 --evaluation-episodes 1 {TINY}"
    limited = "import resource, sys; resource.setrlimit(resource.RLIMIT_NOFILE, (14, 14)); from csac.cli import main; "
    command = [sys.executable, "-c", limited + f"sys.exit(main({shlex.split(line)!r}))"]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert ended.returncode == 1
    assert ended.stderr == (
        "csac: run cannot be written: Too many open files; the run can go on from its last checkpoint (csac resume) "
        "once that is mended\n"
    )
    assert csac(f"resume {tmp_path / 'run'}") == 0
    assert RunDirectory.open(tmp_path / "run").manifest.steps_done == 120


def test_nobody_reading_is_no_error():
    command = [sys.executable, "-m", "csac", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == b""

    assert process.returncode == 0


@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")  # JAX is loaded here; where csac plays, it is not
def test_play_writes_a_video(capsys):
    make_run("run", "Pictures-v0", 3, [-2.0], [2.0])

    assert csac("play run --episodes 2 --video new/film.mp4") == 0

    assert capsys.readouterr().out == (
        "episode 0: return 5.00 in 5 steps\nepisode 1: return 5.00 in 5 steps\nnew/film.mp4\n"
    )
    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", "new/film.mp4", "-f", "rawvideo", "-pix_fmt", "gray", "-"]
    decoded = subprocess.run(decode, capture_output=True, check=True)
    assert b"48x34" in decoded.stderr
    assert b"10 fps" in decoded.stderr
    # Each episode: the first picture and one per step, getting lighter; the last stays until a second is over.
    pictures = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 34 * 48)
    assert np.rint(pictures.mean(axis=1) / 40).tolist() == [0, 1, 2, 3, 4, 5, 5, 5, 5, 5] * 2
    assert [path.name for path in Path("new").iterdir()] == ["film.mp4"]


@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")
def test_small_returns_have_digits(capsys):
    run = make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    run.update_manifest(environment_arguments={"reward": 0.00246})

    assert csac("play run --video film.mp4") == 0
    assert capsys.readouterr().out.startswith("episode 0: return 0.0123 in 5 steps\n")

    assert csac("evaluate run --episodes 2") == 0
    assert words(capsys.readouterr().out)[1] == "0 0.0123 0 0.0123 0.0123 5.0"


def test_the_rows_of_failed_seeds_alone_are_no_file(capsys):
    run = make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    run.update_manifest(failures={0: "step 120: its reward is nan", 1: "step 130: its reward is nan"})

    assert csac("evaluate run --episodes 1 --csv rows.csv") == 1

    output = capsys.readouterr()
    assert "seed 0 failed at step 120: its reward is nan; it is in no mean" in output.out + output.err
    assert output.err.endswith("rows.csv is not written: every seed that was tested had failed in training\n")
    assert not Path("rows.csv").exists()


def test_play_plays_the_perturbed_task(capsys):
    make_run("run", "Pictures-v0", 3, [-2.0], [2.0])

    assert csac("play run --video film.mp4 --perturb friction=2") == 2

    output = capsys.readouterr()
    assert output.out == "perturbed: friction x 2\n"
    assert output.err.startswith("csac: Pictures-v0 is no MuJoCo task")
    assert not Path("film.mp4").exists()


def test_play_without_a_display_points_at_video(monkeypatch, capsys):
    make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")

    assert csac("play run") == 2
    assert capsys.readouterr().err == (
        "csac: there is no display to play on: write a video instead, with --video out.mp4\n"
    )


@pytest.mark.parametrize(
    ("task", "video", "complaint"),
    [
        ("Pictures-v0", "film.gif", "the video is an .mp4 file: name it film.mp4"),
        ("Pictures-v0", ".", "the video is an .mp4 file: name it video.mp4"),
        ("probes:Endless-v0", "film.mp4", "probes:Endless-v0 cannot be drawn: "),
    ],
)
def test_a_video_that_cannot_be_made_is_one_line(capsys, task, video, complaint):
    make_run("run", task, 3, [-2.0], [2.0])

    assert csac(f"play run --trust-task --video {video}") == 2

    output = capsys.readouterr().err
    assert output.startswith(f"csac: {complaint}")
    assert output.count("\n") == 1
    assert not Path(video).is_file()


def test_a_picture_that_fails_names_the_library_and_leaves_no_file(monkeypatch, capsys):
    def render(self):
        raise RuntimeError("Cannot initialize an EGL device display")

    make_run("run", "Pictures-v0", 3, [-2.0], [2.0])
    monkeypatch.setattr(Pictures, "render", render)
    monkeypatch.setenv("MUJOCO_GL", "egl")

    assert csac("play run --video film.mp4") == 2
    assert "apt install libegl1" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["run"]


def test_a_gpu_that_is_not_there_is_one_line(tmp_path):
    result = subprocess.run(
        [sys.executable, "-m", "csac", "train", "Pendulum-v1", "--device", "gpu"],
        cwd=tmp_path,
        env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 2
    hint = "pip install '.[cuda]' in a clone of csac, or choose the cpu"
    assert result.stderr == f"csac: no GPU that JAX can use: {hint}\n"
    assert not any(tmp_path.iterdir())
