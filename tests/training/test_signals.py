"""Signals to what a task has forked."""

import multiprocessing
import signal

import pytest

from csac.training.signals import leaving_at_once, stop_requested


def wait_for_signal(connection):
    connection.send("there")
    while True:  # not `signal.pause`: a signal just before it would wait for another
        pass


@pytest.mark.filterwarnings("ignore:os.fork:RuntimeWarning")
@pytest.mark.parametrize("handled", [leaving_at_once, stop_requested])
def test_a_forked_helper_ends_by_the_signal_whose_handler_it_inherited(handled):
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()
    with handled():
        helper = context.Process(target=wait_for_signal, args=(theirs,), daemon=True)
        helper.start()
        ours.recv()  # Python forgets a signal that comes while it forks
        helper.terminate()
        helper.join(30)
    assert helper.exitcode == -signal.SIGTERM
