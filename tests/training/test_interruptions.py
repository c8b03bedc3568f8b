"""Signals: before there is anything to save, and while the main thread is busy."""

from __future__ import annotations

import errno
import hashlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from csac import SAC, train
from csac.record.run import RunDirectory, StorageFailure
from csac.training.interruptions import caught_signals, signals_noted, storage_failures_told

SWALLOWING = """
import os, signal
from csac.training.interruptions import leaving_at_once

with leaving_at_once():
    try:
        os.kill(os.getpid(), signal.{})
        for _ in range(1000):
            pass
    except BaseException:
        pass
    print("went on")
"""


@pytest.mark.parametrize(("name", "code"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 0)])
def test_before_training_a_signal_is_not_swallowed(name, code):
    ended = subprocess.run([sys.executable, "-c", SWALLOWING.format(name)], capture_output=True, text=True)
    assert ended.returncode == code
    assert ended.stdout == ("went on\n" if code == 0 else "")
    assert ended.stderr == (f"csac: stopped by {name} outside of training; nothing is lost\n" if code else "")


def test_a_signal_while_the_task_is_imported_stops_training(tmp_path):
    (tmp_path / "swallowing.py").write_text(SWALLOWING.format("SIGINT"))
    command = [sys.executable, "-m", "csac", "train", "swallowing:Task-v0", "--directory", "run"]
    ended = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert ended.returncode == 130
    assert ended.stderr == "csac: stopped by SIGINT outside of training; nothing is lost\n"
    assert not (tmp_path / "run").exists()


def test_a_signal_is_told_while_the_main_thread_is_busy():
    """Handlers run between two instructions of the main thread, and a compilation is one of them."""
    order = []
    with caught_signals(lambda: order.append("told")) as (stop, received):
        threading.Timer(0.0, os.kill, (os.getpid(), signal.SIGINT)).start()
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2_000_000)
        order.append("worked")
        assert stop.wait(10)
        assert received == [signal.SIGINT]
    assert order == ["told", "worked"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_second_signal_says_which_it_is(number):
    with caught_signals():
        signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt) as interruption:
            signal.raise_signal(number)
    assert interruption.value.args == (number,)


def test_what_was_there_for_signals_is_there_again():
    def handlers():
        return [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]

    before, descriptor = handlers(), signal.set_wakeup_fd(-1)
    with caught_signals(lambda: None) as (_, received):
        assert handlers() != before
    assert (handlers(), received) == (before, [])
    assert signal.set_wakeup_fd(descriptor) == -1


def test_a_signal_that_comes_too_late_for_a_run_reaches_who_runs_several():
    with signals_noted() as noted:
        with caught_signals() as (stop, received):
            signal.raise_signal(signal.SIGTERM)
            assert stop.is_set()
            assert received == [signal.SIGTERM]
        assert noted == [signal.SIGTERM]
        with caught_signals() as (stop, _):
            assert stop.is_set(), "what begins after it stops at once"
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)


def test_a_signal_that_comes_too_late_for_a_run_alone_is_over_with_it():
    with caught_signals():
        signal.raise_signal(signal.SIGINT)
    with caught_signals() as (stop, received):
        assert (stop.is_set(), received) == (False, [])


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN])
def test_a_file_system_that_has_gone_is_told_in_a_line(number):
    run: Any = SimpleNamespace(path="runs/one")
    told = pytest.raises(StorageFailure, match=f"runs/one cannot be written: {os.strerror(number)}")
    with told, storage_failures_told(run):
        raise OSError(number, os.strerror(number))


def test_a_disk_that_is_full_when_the_run_is_locked_is_told_in_a_line(tmp_path, monkeypatch):
    @contextmanager
    def locked(run: RunDirectory) -> Iterator[None]:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        yield

    monkeypatch.setattr(RunDirectory, "locked", locked)
    with pytest.raises(StorageFailure, match="cannot be written: No space left on device"):
        train(SAC(), "Pendulum-v1", directory=tmp_path / "run", steps=10)
