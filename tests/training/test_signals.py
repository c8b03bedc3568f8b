"""Signals to what a task has forked."""

import multiprocessing
import os
import signal

import pytest

from csac.training.signals import leaving_at_once, stop_requested


@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")
@pytest.mark.parametrize("handled", [leaving_at_once, stop_requested])
def test_a_forked_helper_ends_by_the_signal_whose_handler_it_inherited(handled):
    with handled():
        helper = multiprocessing.get_context("fork").Process(target=signal.pause, daemon=True)
        helper.start()
        helper.terminate()
        helper.join(30)
    assert helper.exitcode == -signal.SIGTERM
