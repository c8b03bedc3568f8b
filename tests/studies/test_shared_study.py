"""Processes that search together: whichever dies, at whatever moment, no trial and no line of the journal is lost."""

import json
from contextlib import suppress

import pytest
from tuning import question

from csac.studies.search_space import Range
from csac.studies.shared_study import SharedStudy


class Killed(BaseException):
    """Stands for the end of a process in the middle of something."""


def killed_at(monkeypatch, owner, name, before):
    """Let a process die at its next call of this, before it or right after it."""
    method = getattr(owner, name)

    def die(*what, **how):
        if not before:
            method(*what, **how)
        raise Killed

    monkeypatch.setattr(owner, name, die)


@pytest.mark.parametrize("before", [True, False])
@pytest.mark.parametrize("name", ["enqueue_trial", "tell"])
@pytest.mark.parametrize("ending", ["give_back", "take back"])
def test_a_process_that_dies_while_it_queues_a_trial_again_loses_none_and_doubles_none(
    tmp_path, monkeypatch, ending, name, before
):
    study, other = (SharedStudy(tmp_path / "study", question()) for _ in range(2))
    first, second = study.next(9), study.next(9)
    assert first is not None
    assert second is not None
    with monkeypatch.context() as patch, suppress(Killed):
        killed_at(patch, study.study, name, before)
        if ending == "give_back":
            study.give_back(second)
            pytest.fail("it was not killed")
        second.lock.close()
        study.next(9)
        pytest.fail("it was not killed")
    second.lock.close()  # as the system does where a process dies

    again, third = other.next(9), other.next(9)
    assert again is not None
    assert third is not None
    assert (again.label, again.values, again.path) == (1, second.values, second.path)
    assert third.label == 2
    for attempt in (first, again, third):
        other.complete(attempt, {1_000: 1.0})
    assert [(result.label, result.state) for result in other.results()] == [(n, "complete") for n in range(3)]


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # its lock, which goes with the process
@pytest.mark.parametrize("moment", ["asked", "before the first draw", "after the first draw"])
@pytest.mark.parametrize("is_again", [False, True])
def test_a_process_that_dies_while_it_begins_a_trial_leaves_its_configuration(tmp_path, monkeypatch, moment, is_again):
    """Both the one that the search begins with, and one that was to go on."""
    study = SharedStudy(tmp_path / "study", question())
    start = {"actor_learning_rate": 3e-4, "discount": 0.99}
    if is_again:
        lost, start = study.next(9), study.next(9)
        assert lost is not None
        assert start is not None
        study.complete(lost, {1_000: 1.0})
        study.give_back(start)
        start = start.values
    with monkeypatch.context() as patch, suppress(Killed):
        if moment == "asked":
            killed_at(patch, study.study, "ask", before=False)
        else:
            killed_at(patch, Range, "draw", before=moment == "before the first draw")
        study.next(9)
        pytest.fail("it was not killed")

    study = SharedStudy(tmp_path / "study", question())
    again, drawn = study.next(9), study.next(9)
    assert again is not None
    assert drawn is not None
    assert (again.label, again.values) == (int(is_again), start)
    assert (drawn.label, drawn.values == start) == (1 + is_again, False)
    for attempt in (again, drawn):
        attempt.lock.close()


def test_a_drawn_configuration_that_could_not_begin_stays_out(tmp_path):
    """It may be the reason."""
    study = SharedStudy(tmp_path / "study", question())
    first, second = study.next(9), study.next(9)
    assert first is not None
    assert second is not None
    study.drop(second)
    third = study.next(9)
    assert third is not None
    assert (third.label, third.values == second.values) == (2, False)
    for attempt in (first, third):
        attempt.lock.close()


def test_a_line_that_another_process_could_not_write_to_its_end_spoils_nothing(tmp_path):
    """Its disk was full, say, and this process was not opened after that."""
    study = SharedStudy(tmp_path / "study", question())
    attempt = study.next(9)
    assert attempt is not None
    for step in (100, 200):
        with open(tmp_path / "study" / "journal.log", "ab") as file:
            file.write(b'{"op_code":8,"worker_id":"4f')
        attempt.trial.report(3.0, step)
    study.complete(attempt, {1_000: 5.0})
    for told in (study, SharedStudy(tmp_path / "study", question())):
        assert [(result.state, result.objective) for result in told.results()] == [("complete", 5.0)]
        assert told.study.trials[0].intermediate_values == {100: 3.0, 200: 3.0}
    lines = (tmp_path / "study" / "journal.log").read_text().splitlines()
    assert all(json.loads(line)["worker_id"] for line in lines)
