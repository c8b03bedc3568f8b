"""A process computes where it was told to, or says that it cannot."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import jax
import pytest

from csac.algorithms import SAC
from csac.training.devices import choose_device
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
    yield config
    jax.config.update("jax_default_matmul_precision", before)


def test_a_gpu_computes_in_float32_and_the_same_in_every_run(a_gpu):
    config = a_gpu
    choose_device("gpu")
    assert [os.environ[name] for name in SETTINGS] == ["--xla_gpu_deterministic_ops=true", "highest", "cuda"]
    assert config.jax_default_matmul_precision == "highest"


@pytest.mark.parametrize(("own", "then"), [(None, "false"), ("true", "true")])
def test_processes_share_a_gpu_s_memory_unless_the_user_will_not(a_gpu, monkeypatch, own, then):
    if own:
        monkeypatch.setenv(MEMORY, own)
    choose_device("gpu")
    assert os.environ[MEMORY] == then


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


def test_another_device_is_refused():
    with pytest.raises(InputError, match="device must be cpu or gpu, not 'tpu'"):
        choose_device("tpu")


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
    finally:
        config.update(name, before)
    assert not (tmp_path / "run").exists()


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
