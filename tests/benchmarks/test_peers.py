"""The speed benchmark without its peers, which are not installed here: its cases, its windows and its report."""

from __future__ import annotations

import inspect
import json
import sys
from argparse import Namespace
from pathlib import Path

import pytest
from measuring import Window, argument_parser, parse

from benchmarks.contenders import CASES, LIBRARIES, REACHES, Case, Reach
from benchmarks.parts import Options
from benchmarks.suites.peers import command, measure, ratios, render, window
from benchmarks.workers import training
from csac.types import InputError


def measured(repetition: int, contender: str, steps_per_second: float) -> dict:
    row = {"repetition": repetition, "setting": "one seed", "contender": contender, "allowed": "XLA, 2 cores"}
    return {**row, "steps_per_second": steps_per_second, "start_seconds": 9.0, "peak_mib": 600.0}


MEASURED = [
    measured(0, "ours", 120.0),
    measured(0, "theirs", 100.0),
    measured(1, "ours", 90.0),
    measured(1, "theirs", 60.0),
    measured(2, "ours", 500.0),
]


def test_a_ratio_is_of_one_repetition():
    assert ratios(MEASURED, "one seed", "ours", "theirs") == [1.2, 1.5]


def test_the_table_says_what_each_was_allowed():
    lines = render(MEASURED, []).splitlines()

    assert "| one seed | theirs | XLA, 2 cores | 80 (60 to 100) | 1.35 (1.20 to 1.50) | 9.0 | 600 |" in lines


def test_what_was_to_be_reached_is_said_of_the_median():
    wanted = [Reach("one seed", "ours", "theirs", 1.3), Reach("one seed", "ours", "theirs", 1.4)]
    lines = render(MEASURED, wanted).splitlines()

    assert "| one seed | ours / theirs | >= 1.3 | 1.35 (1.20 to 1.50) | yes |" in lines
    assert "| one seed | ours / theirs | >= 1.4 | 1.35 (1.20 to 1.50) | **no** |" in lines


def test_each_contender_is_once_in_a_setting_and_the_first_is_ours():
    places = [(case.setting, case.contender) for case in CASES]

    assert len(set(places)) == len(places)
    for setting in {case.setting for case in CASES}:
        assert next(case for case in CASES if case.setting == setting).library == "csac"


def test_what_is_to_be_reached_is_measured_in_every_repetition():
    repeated = {(case.setting, case.contender) for case in CASES if case.repeated}

    for reach in REACHES:
        assert {(reach.setting, reach.contender), (reach.setting, reach.peer)} <= repeated


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_scripts_understand_what_they_are_given(case: Case):
    library = LIBRARIES[case.library]
    arguments = command(case, window(case, Options()))
    if case.library == "csac":
        *_, module, name, given = arguments
        known = Namespace(**inspect.signature(training.measure).bind(**json.loads(given)).arguments)
        counted, unknown = Namespace(**known.counted), []
        assert (module, name) == ("benchmarks.worker", "training")
    else:
        script = next(argument for argument in arguments if argument.endswith(library.script))
        parser = argument_parser("", ("sac", "td3", "ppo"))
        known, unknown = parser.parse_known_args(arguments[arguments.index(script) + 1 :])
        counted = known
        assert Path(script).is_file()
        assert known.threads == (case.threads_each if library.has_threads else None)

    assert unknown == list(library.options)
    assert (known.algorithm, known.seeds) == (case.algorithm, case.seeds)
    assert bool(counted.evaluation_interval) == case.evaluated
    assert counted.warmup == (2048 if case.algorithm == "ppo" else 250)


def test_without_the_peers_nothing_is_measured_and_their_places_are_not_left_empty(monkeypatch):
    monkeypatch.setattr("benchmarks.suites.peers.PEERS_PYTHON", "/no/such/python")

    with pytest.raises(InputError, match="run `make peers` first"):
        measure(CASES[0], Options())


@pytest.mark.parametrize(
    ("case", "allowed"),
    [
        (Case("", "", "csac", seeds=5), "XLA, 2 cores"),
        (Case("", "", "sbx", together=2), "XLA, 1 core each"),
        (Case("", "", "sb3", together=2), "PyTorch, 1 thread each"),
        (Case("", "", "compiled"), "torch.compile, 2 threads"),
        (Case("", "", "parl", threads=1), "Paddle, 1 thread"),
    ],
)
def test_allowed(case: Case, allowed: str):
    assert case.allowed == allowed


def test_a_machine_without_a_compiler_leaves_torch_compile_out(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")

    assert "C++ compiler" in LIBRARIES["compiled"]._replace(python=sys.executable).lacks()
    assert not LIBRARIES["eager"]._replace(python=sys.executable).lacks()
    assert "make peers" in LIBRARIES["eager"]._replace(python="/no/such/python").lacks()


def test_a_window_begins_once_settled_and_counts_its_steps(capsys):
    window = Window(Namespace(warmup=3, settled=5, seconds=0.0, steps=4, launched=0.0, together=False))

    assert next(step for step in range(3, 12) if window.is_over_at(step)) == 9
    assert (window.first, window.start_seconds > 0) == (5, True)

    window.report([-300.4, 12.0])
    reported = json.loads(capsys.readouterr().out)
    assert (reported["steps"], reported["returns"]) == (4, [-300, 12])
    assert reported["steps_per_second"] == pytest.approx(4 / reported["seconds"])
    assert {"start_seconds", "peak_mib"} < reported.keys()


def test_a_peer_that_cannot_evaluate_says_so(capsys):
    with pytest.raises(SystemExit) as stopped:
        parse(argument_parser("", ("sac",)), given=["--evaluation-interval", "250"])

    assert stopped.value.code == 2
    assert "without evaluation" in capsys.readouterr().err
