import subprocess
import sys

import pytest

import csac


def modules_after(code: str) -> set[str]:
    """The top-level packages that a fresh interpreter holds after `code`."""
    report = "import sys; print('MODULES', *{name.partition('.')[0] for name in sys.modules})"
    done = subprocess.run([sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True)
    return set(done.stdout.split("MODULES ")[1].split())


def test_importing_csac_imports_neither_jax_nor_gymnasium_nor_numpy():
    assert not {"jax", "gymnasium", "numpy", "tyro", "rich"} & modules_after("import csac")


def test_the_light_names_stay_light():
    code = "from csac import InputError, Policy, load, __version__; import csac.presets"

    assert not {"jax", "gymnasium", "matplotlib"} & modules_after(code)


@pytest.mark.parametrize("arguments", [["--help"], ["runs", "."], ["evaluate", "--help"], ["play", "--help"]])
def test_what_needs_no_learning_imports_no_jax(arguments):
    code = f"import csac.cli\nassert csac.cli.main({arguments!r}) == 0"

    assert not {"jax", "equinox", "optax"} & modules_after(code)


def test_the_help_of_train_imports_no_task_and_no_picture():
    code = "import csac.cli\nassert csac.cli.main(['train', '--help']) == 0"

    assert not {"gymnasium", "mujoco", "matplotlib", "scipy", "tensorboardX"} & modules_after(code)


def test_what_only_the_end_of_a_run_needs_is_not_imported_at_its_start():
    code = "import csac.training.train, csac.console.progress, csac.training.scheduler"

    assert not {"matplotlib", "scipy", "tensorboardX", "imageio_ffmpeg"} & modules_after(code)


@pytest.mark.parametrize("name", csac.__all__)
def test_public_names_resolve(name):
    assert getattr(csac, name) is not None
    assert name in dir(csac)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'TRPO'"):
        csac.TRPO  # noqa: B018


def test_the_version_is_the_installed_one():
    assert csac.__version__.count(".") == 2
