"""The commands themselves."""

from __future__ import annotations

import io
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from typed import NOTHING, SUPPORT, TINY, Pictures, csac, make_run, words

import csac.training.train as training
from csac.cli import main
from csac.commands import Chosen
from csac.record.csv_tables import read_rows
from csac.record.manifest import Origin
from csac.record.run import RunDirectory
from csac.training import interruptions


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
        ("friction=2", "probes:Endless-v0 is no MuJoCo task"),
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

    assert csac("export run --episodes 0") == 0

    assert capsys.readouterr().out.splitlines()[-1] == note


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


@pytest.mark.parametrize(("can_go_on", "line"), [(True, "; to go on, type: csac resume 'my run'"), (False, "")])
def test_a_second_signal_says_what_is_lost(monkeypatch, capsys, can_go_on, line):
    def train(*_, **__):
        raise interruptions.StoppedAtOnce(RunDirectory(Path("my run"), NOTHING), can_go_on, signal.SIGTERM)

    monkeypatch.setattr(training, "train", train)

    assert csac("train Hopper-v4") == 143
    lost = "csac: stopped at once: what my run did since its last checkpoint is lost"
    assert capsys.readouterr().err == f"{lost}{line}\n"


def test_a_run_that_is_there_needs_no_source_any_more(tmp_path):
    """A scheduler types the same line again; meanwhile the source has trained on, or is gone."""
    run = make_run(tmp_path / "fork", "Hopper-v4", 3, [-1.0], [1.0])
    run.update_manifest(forked_from=Origin(str(tmp_path / "gone"), 400))
    run.checkpoints.mkdir()
    (run.checkpoints / "step_400.json").write_text("{}")
    chosen = Chosen.among(["--from", str(tmp_path / "gone@400"), "--directory", str(run.path), "--resume"])
    assert chosen.source == run.manifest


@pytest.mark.parametrize("state", [{"is_saved": True}, {"is_saved": False, "begins_anew": True}])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_run_says_what_to_type(monkeypatch, capsys, number, code, state):
    def train(*_, **__):
        raise training.Interrupted(RunDirectory(Path("my run"), NOTHING), number, **state)

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


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is always full is Linux's")
def test_a_full_disk_behind_the_output_is_an_error():
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "csac", "--help"]
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert ended.stderr == "csac: not all of the output could be written: No space left on device\n"
    assert ended.returncode == 1


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
        ("Pictures-v0", "film.gif", "the video is an .mp4 file: name it so, not film.gif"),
        ("Pictures-v0", ".", "the video is an .mp4 file: name it so, not ."),
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
