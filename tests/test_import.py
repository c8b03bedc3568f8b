import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import drawn
import pytest
from manifests import manifest
from policies import contract, random_policy

import csac
from csac.algorithms import ALGORITHMS
from csac.record.run import RunDirectory


@pytest.fixture
def tiny_run(tmp_path):
    """A folder with a finished run, a policy that has learnt nothing, and its task, which can be drawn."""
    shutil.copy(drawn.__file__, tmp_path)
    run = RunDirectory.create(tmp_path / "run", manifest(task="drawn:Drawn-v0", steps=9))
    run.append("evaluations", [{"seed": 0, "step": 9, "episode": 0, "return": 1.0, "length": 5, "success": None}])
    random_policy(contract()).write(run.policy_file())
    return tmp_path


def modules_after(code: str, folder: Path | None = None) -> set[str]:
    """The top-level packages that a fresh interpreter, in this folder, holds after `code`."""
    report = "import sys; print('MODULES', *{name.partition('.')[0] for name in sys.modules})"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], cwd=folder, capture_output=True, text=True, check=True
    )
    return set(done.stdout.split("MODULES ")[1].split())


def test_importing_csac_imports_neither_jax_nor_gymnasium_nor_numpy():
    assert not {"jax", "gymnasium", "numpy", "tyro", "rich"} & modules_after("import csac")


def test_loading_a_policy_imports_no_jax_and_no_task(tiny_run):
    code = "from csac import InputError, Policy, load, __version__; import csac.presets, numpy"
    code += "; load('run').predict(numpy.zeros(2))"

    assert not {"jax", "jaxlib", "equinox", "optax", "gymnasium", "matplotlib"} & modules_after(code, tiny_run)


def test_what_needs_no_learning_imports_no_jax(tiny_run):
    code = """
import csac.cli
from csac import evaluate, evaluate_episodes, load
for line in (
    "--help",
    "--version",
    "runs .",
    "evaluate --help",
    "play --help",
    "evaluate run --trust-task --episodes 40 --processes 2 --csv episodes.csv",
    "evaluate run --trust-task --stochastic --perturb action_noise=0.1",
    "play run --trust-task --video film.mp4",
):
    assert csac.cli.main(line.split()) == 0, line
assert evaluate(load('run'), 'drawn:Drawn-v0', episodes=1) == evaluate_episodes(load('run'), 'drawn:Drawn-v0', 1)[0][1]
"""

    assert not {"jax", "jaxlib", "equinox", "optax"} & modules_after(code, tiny_run)


def test_the_help_of_train_imports_no_task_and_no_picture():
    code = "import csac.cli\nassert csac.cli.main(['train', '--help']) == 0"

    assert not {"gymnasium", "mujoco", "matplotlib", "scipy", "tensorboardX"} & modules_after(code)


def test_what_only_the_end_of_a_run_needs_is_not_imported_at_its_start():
    code = "import csac.training.train, csac.console.progress, csac.training.supervisor"

    assert not {"matplotlib", "scipy", "tensorboardX", "imageio_ffmpeg"} & modules_after(code)


@pytest.mark.parametrize("name", csac.__all__)
def test_public_names_resolve(name):
    assert getattr(csac, name) is not None
    assert name in dir(csac)


def test_an_algorithm_is_wherever_its_page_says():
    """What docs/adding-an-algorithm.md lists beside presets and the search space, which have tests of their own."""
    root = Path(__file__).parents[1]
    (kept_apart,) = [
        contract["modules"]
        for contract in tomllib.loads(root.joinpath("pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
        if contract["type"] == "independence"
    ]
    for name, algorithm in ALGORITHMS.items():
        assert algorithm.__name__ in csac.__all__
        assert algorithm.__module__ in kept_apart
        assert root.joinpath("docs", "algorithms", f"{name}.md").is_file()


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'TRPO'"):
        csac.TRPO  # noqa: B018


def test_the_version_is_the_project_s():
    project = tomllib.loads(Path(__file__).parents[1].joinpath("pyproject.toml").read_text())["project"]
    assert csac.__version__ == project["version"]
