"""The commands themselves."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from shown import make_set
from typed import SUPPORT, TINY, Pictures, csac, make_runs, words

import csac.training.train as training
from csac.record.run import StorageFailure
from csac.record.sets import RunSet
from csac.record.tables import read_rows
from csac.training.signals import Interrupted


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Two seeds, trained by the command line on a task of constant reward: (exit code, their directory)."""
    directory = tmp_path_factory.mktemp("trained") / "runs"
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(SUPPORT)
        code = csac(
            f"train probes:Endless-v0 --directory {directory} --steps 40 --warmup-steps 20 --seeds 2 "
            f"--seeds-per-process 2 --evaluation-interval 20 {TINY}"
        )
    return code, directory


def test_train_writes_a_set_of_runs(trained):
    code, directory = trained
    runs = RunSet.open(directory)
    assert (code, runs.state, runs.seeds) == (0, "finished", [0, 1])
    assert (runs.runs[0].manifest.command or "").startswith("csac train probes:Endless-v0 --directory ")
    assert runs.config.hyperparameters["batch_size"] == 8
    assert (len(runs.evaluations), set(runs.evaluations["return"])) == (2 * 2 * 10, {10.0})
    assert runs.curve.exists()


@pytest.mark.parametrize(("where", "seeds"), [("", ["0", "1"]), ("seed-1", ["1"]), (" --seed 0", ["0"])])
def test_evaluate_takes_a_set_a_run_and_a_seed(trained, capsys, where, seeds):
    assert csac(f"evaluate {trained[1]}/{where} --episodes 2 --csv rows.csv") == 0
    told = words(capsys.readouterr().out)
    assert told[0] == "seed mean return ± std min max length"
    assert told[1 : 1 + len(seeds)] == [f"{seed} 10.00 0.00 10.00 10.00 10.0" for seed in seeds]
    assert told[1 + len(seeds) : -1] == (["mean 10.00", "2 seeds: no interval"] if len(seeds) > 1 else [])
    rows = read_rows("rows.csv")
    assert (set(rows["step"]), len(rows)) == ({40}, 2 * len(seeds))


def test_evaluate_says_what_was_perturbed_and_what_was_not(trained, capsys):
    perturb = "--perturb observation-noise=0.1 --perturb action_noise=0.2"
    assert csac(f"evaluate {trained[1]} --seed 1 --episodes 1 {perturb}") == 0
    assert words(capsys.readouterr().out)[0] == "perturbed: observation noise 0.1, action noise 0.2"
    make_runs("runs", perturbations=("action_noise=0.1@50",))
    assert csac("evaluate runs --seed 0 --episodes 1") == 0
    assert "action_noise=0.1@50" in capsys.readouterr().out.splitlines()[0]


def test_evaluate_samples_where_it_is_asked_to():
    make_runs("runs", "probes:ActionReward-v0", 1, -1.0, 1.0)

    def returns(options, name):
        assert csac(f"evaluate runs --seed 0 --episodes 4 --trust-task --csv {name}.csv {options}") == 0
        return read_rows(f"{name}.csv")["return"].tolist()

    assert returns("", "steady") == [-0.25] * 4  # the action 0, where 0.5 were best
    assert len(set(returns("--stochastic", "sampled"))) == 4


def test_the_rows_of_failed_seeds_alone_are_no_file(capsys):
    for run in make_runs("runs").runs:
        run.update_manifest(state="failed", failure="step 120: its reward is nan")
    assert csac("evaluate runs --episodes 1 --csv rows.csv") == 0
    assert "seed 0 failed at step 120: its reward is nan; it is in no mean, and in no file" in capsys.readouterr().out
    assert not Path("rows.csv").exists()


def test_runs_has_a_line_for_each_set(trained, tmp_path, capsys):
    assert csac(f"runs {trained[1].parent}") == 0
    assert words(capsys.readouterr().out)[1:] == [f"probes:Endless-v0 csac 2 40 / 40 finished 10.00 {trained[1]}"]
    make_set(tmp_path / "runs" / "whole", [[1.0]])
    broken = make_set(tmp_path / "runs" / "broken", [[1.0]]).runs[0].path
    (broken / "manifest.json").write_bytes(b'{"schema_version": 2, "ta')
    assert csac("runs") == 0
    _, whole, damaged = words(capsys.readouterr().out)
    assert whole.endswith("runs/whole")
    assert damaged.startswith(f"damaged: {broken}")


def test_runs_without_any_says_how_to_start_one(capsys):
    assert csac("runs") == 0
    assert capsys.readouterr().out.startswith("no runs in runs yet; csac train ")


def test_a_failed_seed_is_exit_code_3(capsys):
    code = csac(
        """train probes:Failing-v0 --directory runs --env-kwargs '{"where": "step", "at": 30}' --steps 50 """
        f"--evaluation-interval 25 --evaluation-episodes 1 {TINY}"
    )
    assert code == 3
    assert "seed 0 failed at step 30: " in capsys.readouterr().out
    assert RunSet.open("runs").state == "failed"


@pytest.mark.parametrize(
    ("raised", "code", "told"),
    [
        (lambda runs: Interrupted(runs, signal.SIGINT), 130, "type: csac resume '"),
        (lambda runs: Interrupted(runs, signal.SIGTERM), 143, "type: csac resume '"),
        (lambda runs: KeyboardInterrupt(signal.SIGTERM), 143, "what came after the last checkpoint is lost"),
        (lambda runs: KeyboardInterrupt(), 130, "what came after the last checkpoint is lost"),
        (lambda runs: StorageFailure("runs cannot be written: the disk is full"), 1, "the disk is full"),
    ],
)
def test_what_ends_training_has_an_exit_code_and_a_line(monkeypatch, capsys, raised, code, told):
    error = raised(make_set(Path("my runs"), [[1.0]], state="interrupted"))

    def train(*_, **__):
        raise error

    monkeypatch.setattr(training, "train", train)
    monkeypatch.setattr("csac.cli.commands.leave", lambda code: code)
    assert csac("train Hopper-v4") == code
    output = capsys.readouterr().err
    assert told in output
    assert output.count("\n") == 1


@pytest.mark.parametrize(("number", "seeds"), [(signal.SIGTERM, 1), (signal.SIGINT, 2)])
def test_a_signal_saves_checkpoints_of_all_seeds(tmp_path, number, seeds):
    """A terminal sends Ctrl-C to all processes; only the first may act on it."""
    line = "train probes:Endless-v0 --directory runs --steps 1e8 --warmup-steps 1e8 --replay-size 1e3 "
    line += f"--seeds {seeds} --evaluation-interval 250 {TINY}"
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
    assert errors.startswith(f"csac: stopped by {number.name}; saved in ")
    assert errors.count("\n") == 1
    assert "stopped at step" in output
    assert "failed" not in output
    for run in RunSet.open(tmp_path / "runs").runs:
        assert run.manifest.state == "interrupted"
        assert 250 <= run.manifest.steps_done == run.manifest.last_checkpoint
    assert csac("evaluate runs --episodes 1") == 0


@pytest.mark.parametrize(("to", "code", "told"), [(">&-", 0, b""), (">/dev/full", 1, b"csac: standard output cannot")])
def test_a_closed_standard_output_is_no_mistake_and_a_full_disk_is_one_line(to, code, told):
    command = f"PYTHONUNBUFFERED= {shlex.quote(sys.executable)} -m csac runs {to}"
    process = subprocess.run(["sh", "-c", command], stderr=subprocess.PIPE)
    assert (process.returncode, process.stderr[:28]) == (code, told)


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
    make_runs("runs", environment_arguments={"reward": 0.00246})
    assert csac("play runs --episodes 2 --video new/film.mp4") == 0
    told = ["episode 0: return 0.0123 in 5 steps", "episode 1: return 0.0123 in 5 steps", "new/film.mp4"]
    assert capsys.readouterr().out.splitlines() == told
    decode = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", "new/film.mp4", "-f", "rawvideo", "-pix_fmt", "gray", "-"]
    decoded = subprocess.run(decode, capture_output=True, check=True)
    assert b"48x34" in decoded.stderr
    assert b"10 fps" in decoded.stderr
    # Each episode: the first picture and one per step, getting lighter; the last stays until a second is over.
    pictures = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 34 * 48)
    assert np.rint(pictures.mean(axis=1) / 40).tolist() == [0, 1, 2, 3, 4, 5, 5, 5, 5, 5] * 2
    assert [path.name for path in Path("new").iterdir()] == ["film.mp4"]


@pytest.mark.parametrize(
    ("task", "options", "told"),
    [
        ("Pictures-v0", "--video film.mp4 --perturb friction=2", "Pictures-v0 is no MuJoCo task"),
        ("Pictures-v0", "", "--video"),
        ("probes:Endless-v0", "--video film.mp4", "probes:Endless-v0 cannot be drawn"),
    ],
)
def test_what_cannot_be_played_is_one_line(monkeypatch, capsys, task, options, told):
    make_runs("runs", task)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert csac(f"play runs --trust-task {options}") == 2
    output = capsys.readouterr().err
    assert told in output
    assert output.count("\n") == 1
    assert [path.name for path in Path().iterdir()] == ["runs"]


def test_a_picture_that_fails_names_the_library_and_leaves_no_file(monkeypatch, capsys):
    def render(self):
        raise RuntimeError("Cannot initialize an EGL device display")

    make_runs("runs")
    monkeypatch.setattr(Pictures, "render", render)
    monkeypatch.setenv("MUJOCO_GL", "egl")
    assert csac("play runs --video film.mp4") == 2
    assert "apt install libegl1" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["runs"]
