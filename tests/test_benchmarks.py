"""The speed benchmark without its peers, which are not installed here: its cases, its windows and its report."""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from pathlib import Path

import csac_speed
import pytest
from cases import CASES, HERE, LIBRARIES, REACHES, Case
from measuring import Window, argument_parser, parse
from products import Network, Product, operations, update_products
from report import Measurement, markdown, ratios, write_between_markers
from speed import Protocol, command


def measurement(repetition: int, contender: str, steps_per_second: float) -> Measurement:
    return Measurement(repetition, "one seed", contender, "XLA, 2 cores", steps_per_second, 500, 5.0, 9.0, 600.0, 0.0)


MEASURED = [
    measurement(0, "ours", 120.0),
    measurement(0, "theirs", 100.0),
    measurement(1, "ours", 90.0),
    measurement(1, "theirs", 60.0),
    measurement(2, "ours", 500.0),
]


def test_a_ratio_is_of_one_repetition():
    assert ratios(MEASURED, "one seed", "ours", "theirs") == [1.2, 1.5]


def test_the_table_says_what_each_was_allowed(tmp_path):
    path = tmp_path / "README.md"
    path.write_text("before\n<!-- measured: begin -->\nold\n<!-- measured: end -->\nafter\n")

    write_between_markers(path, markdown(MEASURED, [], ["a machine"]))

    lines = path.read_text().splitlines()
    assert [lines[0], lines[-1]] == ["before", "after"]
    assert "old" not in lines
    assert "| one seed | theirs | XLA, 2 cores | 80 (60 to 100) | 1.35 (1.20 to 1.50) | 9.0 | 600 |" in lines


def test_each_contender_is_once_in_a_setting_and_the_first_is_ours():
    places = [(case.setting, case.contender) for case in CASES]

    assert len(set(places)) == len(places)
    for setting in {case.setting for case in CASES}:
        assert next(case for case in CASES if case.setting == setting).library == "csac"


def test_what_is_to_be_reached_is_measured_in_every_repetition():
    repeated = {(case.setting, case.contender) for case in CASES if case.repeated}

    for reach in REACHES:
        assert {(reach.setting, reach.contender), (reach.setting, reach.peer)} <= repeated


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.setting}: {case.contender}")
def test_the_scripts_understand_what_they_are_given(case: Case):
    library = LIBRARIES[case.library]
    arguments = command(case, Protocol(), [0, 1])
    script = arguments.index(str(HERE / library.script))

    if case.library == "csac":
        known, unknown = csac_speed.parse(arguments[script + 1 :]), []
    else:
        algorithms = ("sac", "td3", "ppo")
        known, unknown = argument_parser("", algorithms).parse_known_args(arguments[script + 1 :])
        assert known.threads == (case.threads_each if library.has_threads else None)

    assert Path(arguments[script]).is_file()
    assert unknown == list(library.options)
    assert (known.algorithm, known.seeds) == (case.algorithm, case.seeds)
    assert bool(known.evaluation_interval) == case.evaluated


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


def test_the_products_of_a_small_network_by_hand():
    network = Network((3, 5, 2))
    assert network.forward(7) == {Product(7, 3, 5): 1, Product(7, 5, 2): 1}
    assert network.weight_gradient(7) == {Product(3, 7, 5): 1, Product(5, 7, 2): 1}
    assert network.input_gradient(7) == {Product(7, 2, 5): 1}  # the network's own inputs are data
    assert network.input_gradient(7, 1) == {Product(7, 2, 5): 1, Product(7, 5, 1): 1}
    assert operations(dict(network.forward(7))) == 2 * 7 * (3 * 5 + 5 * 2)


@pytest.mark.parametrize(("algorithm", "hidden"), [("csac", 18), ("sac", 16), ("td3", 11.5)])
def test_the_products_of_an_update(algorithm, hidden):
    # By hand, in hidden products of one network: forward 1, learning 3, a gradient through a critic 2.
    # CSAC: target 1 + 1 + 2, critics 3 + 3, actor 3 + 1 + 2 + 2. SAC has no reference, twice 1.
    # TD3: target 1 + 2, critics 3 + 3, and every other time actor 3 and one critic 2.
    counts = update_products(algorithm)
    assert counts[Product(256, 256, 256)] == hidden
    assert 1 < operations(counts) / (hidden * Product(256, 256, 256).operations) < 1.1  # the edges are small


def test_a_table_goes_between_its_own_markers(tmp_path):
    path = tmp_path / "page.md"
    path.write_text("<!-- a: begin -->\n<!-- a: end -->\n<!-- b: begin -->\nold\n<!-- b: end -->\n")
    write_between_markers(path, "new\n", "b")
    assert path.read_text() == "<!-- a: begin -->\n<!-- a: end -->\n<!-- b: begin -->\nnew\n<!-- b: end -->\n"
    with pytest.raises(SystemExit, match="lacks the lines <!-- c: begin -->"):
        write_between_markers(path, "new\n", "c")
