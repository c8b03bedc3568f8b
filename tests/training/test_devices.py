"""A process computes where it was told to, or says that it cannot."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from functools import partial
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import pytest

from csac.algorithms import SAC
from csac.processes import cores_to_use
from csac.record.run import RunDirectory
from csac.training import devices
from csac.training import provenance as provenance_module
from csac.training.devices import choose_device, in_use, preallocates
from csac.training.train import train
from csac.types import InputError


@pytest.fixture(autouse=True)
def on_the_cpu(monkeypatch):
    """What a test chooses is forgotten."""
    config: Any = jax.config
    before = config.jax_platforms
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    jax.config.update("jax_platforms", "cpu")
    assert jax.default_backend() == "cpu"
    yield
    jax.config.update("jax_platforms", before)


def test_a_process_that_has_computed_on_the_cpu_refuses_the_gpu():
    with pytest.raises(InputError, match="device must be cpu or gpu, not 'tpu'"):
        choose_device("tpu")
    choose_device("cpu")
    with pytest.raises(InputError, match="this process computes on the cpu already: train on the gpu in a new one"):
        choose_device("gpu")
    config: Any = jax.config
    assert config.jax_platforms == os.environ["JAX_PLATFORMS"] == "cpu"
    choose_device("cpu")


SETTINGS = ("XLA_FLAGS", "JAX_DEFAULT_MATMUL_PRECISION", "JAX_PLATFORMS")
MEMORY = "XLA_PYTHON_CLIENT_PREALLOCATE"


@pytest.fixture
def a_gpu(monkeypatch):
    """JAX's settings: it finds a GPU, and nothing is set of its numbers."""
    config: Any = jax.config
    before = config.jax_default_matmul_precision
    for name in SETTINGS:
        monkeypatch.setenv(name, "")
    monkeypatch.setenv(MEMORY, "")
    monkeypatch.delenv(MEMORY)
    jax.config.update("jax_default_matmul_precision", None)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(devices, "_has_looked_for_devices", lambda: False)
    yield config
    jax.config.update("jax_default_matmul_precision", before)


def test_a_gpu_computes_in_float32_and_the_same_in_every_run(a_gpu):
    config = a_gpu
    choose_device("gpu")
    assert [os.environ[name] for name in SETTINGS] == ["--xla_gpu_deterministic_ops=true", "highest", "cuda"]
    assert config.jax_default_matmul_precision == "highest"


@pytest.mark.parametrize(("own", "then"), [(None, "false"), ("", "false"), ("true", "true")])
def test_processes_share_a_gpu_s_memory_unless_the_user_will_not(a_gpu, monkeypatch, own, then):
    if own is not None:
        monkeypatch.setenv(MEMORY, own)
    choose_device("gpu")
    assert os.environ[MEMORY] == then
    assert preallocates() == (then == "true")


def test_what_comes_too_late_for_a_gpu_is_not_said_to_hold(a_gpu, monkeypatch):
    monkeypatch.setattr(devices, "_has_looked_for_devices", lambda: True)
    with pytest.warns(UserWarning, match="JAX was in use before csac, so runs on this GPU may differ"):
        choose_device("gpu")
    assert os.environ["XLA_FLAGS"] == ""
    assert MEMORY not in os.environ
    monkeypatch.setenv("XLA_FLAGS", "--xla_gpu_deterministic_ops=true")  # as the first of two runs has left it
    with warnings.catch_warnings(action="error"):
        choose_device("gpu")


def test_it_is_seen_whether_jax_has_looked_for_devices():
    program = """
import jax
from csac.training.devices import _has_looked_for_devices
before = _has_looked_for_devices()
jax.devices()
print(before, _has_looked_for_devices())
"""
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
    assert said == "False True\n"


@pytest.mark.parametrize("device", ["cpu", "gpu"])
def test_a_precision_that_a_program_sets_reaches_its_workers(a_gpu, monkeypatch, device):
    jax.config.update("jax_default_matmul_precision", "tensorfloat32")
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    choose_device(device)
    assert os.environ["JAX_DEFAULT_MATMUL_PRECISION"] == in_use()["matmul_precision"] == "tensorfloat32"


def test_what_the_user_has_set_of_a_gpu_s_numbers_stays(a_gpu, monkeypatch):
    own = "--xla_gpu_deterministic_ops=false --xla_gpu_autotune_level=1"
    monkeypatch.setenv("XLA_FLAGS", own)
    jax.config.update("jax_default_matmul_precision", "tensorfloat32")
    choose_device("gpu")
    assert os.environ["XLA_FLAGS"] == own
    assert a_gpu.jax_default_matmul_precision == "tensorfloat32"


@pytest.mark.parametrize("flags", ["", "--xla_some_flag=1"])
def test_a_gpu_that_is_not_to_be_had_leaves_no_setting_behind(a_gpu, monkeypatch, flags):
    monkeypatch.setenv("XLA_FLAGS", flags)
    monkeypatch.setattr(jax, "default_backend", lambda: "cpu")
    with pytest.raises(InputError, match="this process computes on the cpu already"):
        choose_device("gpu")
    assert os.environ.get("XLA_FLAGS", "") == flags
    assert a_gpu.jax_default_matmul_precision is None


def test_a_gpu_s_libraries_are_recorded(monkeypatch):
    installed = {"nvidia-cublas": "13.1", "jax-cuda13-plugin": "0.11", "nvidia": "1", "rich": "14"}
    named = [SimpleNamespace(name=name) for name in (*installed, None)]  # None: an installation that was broken off
    monkeypatch.setattr(provenance_module, "distributions", lambda: named)
    monkeypatch.setattr(provenance_module, "version", lambda name: installed.get(name, "2"))
    monkeypatch.setattr(provenance_module, "in_use", lambda: {"gpu": "GPU A"})
    on_gpu = provenance_module.provenance("Pendulum-v1", None, 1)["versions"]
    monkeypatch.setattr(provenance_module, "in_use", lambda: {"gpu": ""})
    on_cpu = provenance_module.provenance("Pendulum-v1", None, 1)["versions"]
    assert on_gpu == {**on_cpu, "jax-cuda13-plugin": "0.11", "nvidia-cublas": "13.1"}


def changing(name: str, value: Any) -> gymnasium.Env:
    """A task that changes JAX's settings."""
    jax.config.update(name, value)
    return gymnasium.make("Pendulum-v1")


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("jax_enable_x64", True, "csac computes in 32 bits and JAX is set to 64: unset JAX_ENABLE_X64"),
        ("jax_default_prng_impl", "rbg", "csac's keys are of JAX's threefry2x32: unset JAX_DEFAULT_PRNG_IMPL"),
    ],
)
def test_other_numbers_than_csac_s_are_refused_before_a_run_begins(tmp_path, name, value, message):
    config: Any = jax.config
    before = getattr(config, name)
    config.update(name, value)
    try:
        with pytest.raises(InputError, match=message):
            train(SAC(), "Pendulum-v1", steps=10, directory=tmp_path / "run")
        config.update(name, before)
        with pytest.raises(InputError, match=message):
            train(SAC(), partial(changing, name, value), steps=10, directory=tmp_path / "run")
        assert not (tmp_path / "run").exists()
    finally:
        config.update(name, before)


@pytest.mark.slow
def test_a_seed_that_is_resumed_alone_has_the_threads_that_it_began_with(tmp_path):
    """Two seeds train with half of the cores each; of these depend the last bits."""
    small = "--actor-hidden-sizes 8 --critic-hidden-sizes 8 --batch-size 8 --warmup-steps 20 --evaluation-interval 50"
    for line in (f"train Pendulum-v1 --seeds 2 --steps 50 {small} --directory runs", "resume runs/seed-0 --steps 100"):
        subprocess.run([sys.executable, "-m", "csac", *line.split()], cwd=tmp_path, check=True)
    before, after = (RunDirectory.open(tmp_path / "runs" / f"seed-{seed}").manifest.machine for seed in (1, 0))
    assert after.cores == before.cores == max(1, cores_to_use() // 2)


FIRST_THE_GPU = """
import jax, os
from csac.training.devices import choose_device
try:
    choose_device("gpu")
    print("gpu", jax.default_backend(), os.environ["JAX_PLATFORMS"])
except ValueError as error:
    print(error)
    choose_device("cpu")
    print(jax.default_backend(), os.environ["JAX_PLATFORMS"])
"""


def test_without_a_gpu_the_cpu_can_still_be_chosen():
    surroundings = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    command = [sys.executable, "-c", FIRST_THE_GPU]
    said = subprocess.run(command, env=surroundings, capture_output=True, text=True, check=True).stdout.strip()
    without = "no GPU that JAX can use: pip install '.[cuda]' in a clone of csac, or choose the cpu\ncpu cpu"
    assert said in (without, "gpu gpu cuda")
