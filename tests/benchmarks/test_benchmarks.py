"""What all benchmarks share: turns, rows and tables in files, processes, and the command line."""

from __future__ import annotations

import re
import sys
from functools import cache
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks import checkpoint, gpu
from benchmarks.__main__ import PARTS, SUITES, main, named
from benchmarks.measuring import ROOT, Launch, ProcessFailure, answers, machine, usable_cores
from benchmarks.part import RESULTS, Options, Part
from csac.types import InputError


class Case(NamedTuple):
    name: str


def part(**changes) -> Part:
    given = {"cases": ["a", "b"], "measure": lambda case, options: [{"case": case, "speed": 1.5}]}
    return Part(**{"name": "it", "page": "page.md", "about": "", "render": {"of": "{case}"}, **given, **changes})


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (Options(), [(0, "a"), (0, "b"), (1, "a"), (1, "b")]),  # in turns
        (Options(only="b"), [(0, "b"), (1, "b")]),
        (Options(only="nothing"), []),
        (Options(quick=True), [(0, "a")]),
        (Options(repetitions=1), [(0, "a"), (0, "b")]),
    ],
)
def test_which_cases_are_measured(options, expected):
    rows = part(repetitions=2).run(options)
    assert [(row["repetition"], row["case"]) for row in rows] == expected


def test_the_cases_that_pages_measure_alone_exist():
    cases = [getattr(case, "name", case) for part in PARTS for case in part.cases]
    pages = (*ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/*.md"))
    wanted = [text for page in pages for text in re.findall(r"""--only "(.+?)\"""", page.read_text())]
    assert wanted
    assert [text for text in wanted if not any(text in case for case in cases)] == []


def test_pages_name_only_benchmarks_that_exist():
    pages = (*ROOT.glob("docs/**/*.md"), ROOT / "README.md", *ROOT.glob("benchmarks/*.md"))
    names = {name for page in pages for name in re.findall(r"python -m benchmarks ([a-z-]+)", page.read_text())}
    assert names <= {*SUITES, *(part.name for part in PARTS), "render"}


def test_a_table_is_written_between_the_markers_of_its_page(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- it: begin -->\nold\n<!-- it: end -->\nafter\n")
    measured = part()
    measured.publish(tmp_path, tmp_path)
    assert "Not measured yet: `python -m benchmarks it --write`" in page.read_text()

    measured.write(measured.run(Options()), ["a machine"], tmp_path)
    measured.publish(tmp_path, tmp_path)
    table = "| of |\n| --- |\n| a |\n| b |\n\n- a machine\n"
    assert page.read_text() == f"before\n<!-- it: begin -->\n{table}<!-- it: end -->\nafter\n"
    with pytest.raises(ValueError, match="lacks the lines <!-- other: begin -->"):
        part(name="other").publish(tmp_path, tmp_path)


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_the_committed_tables_follow_from_their_rows(part: Part, tmp_path):
    page, copy = ROOT / part.page, tmp_path / part.page
    copy.parent.mkdir(parents=True, exist_ok=True)
    copy.write_text(page.read_text())
    part.publish(root=tmp_path)
    assert copy.read_text() == page.read_text(), "run `python -m benchmarks render`"


def test_every_committed_file_belongs_to_a_benchmark_or_is_shown():
    pages = "".join(page.read_text() for page in (*ROOT.glob("docs/**/*.md"), *ROOT.glob("benchmarks/*.md")))
    names = {part.name for part in PARTS}
    assert [path.name for path in RESULTS.iterdir() if path.stem not in names and path.name not in pages] == []


def test_a_checkpoint_costs_what_the_steps_around_it_take_longer(tmp_path):
    stamp = np.array([[step, step / 1000 + 0.25 * (step >= 2_000)] for step in range(250, 3_001, 250)])
    old, new = {tmp_path / "a": 5, tmp_path / "b": 6}, {tmp_path / "b": 6, tmp_path / "c": 7}
    row = checkpoint.row(1, 2_000, stamp, {0: old, 1: new})
    assert row.pop("seconds") == pytest.approx(0.25)
    assert row == {"transitions": 2_000, "bytes": 7, "folder_bytes": 13}


def test_devices_are_compared_by_all_that_is_learnt():
    ours = {"a": np.array([1.0, -2.0]), "b": np.array([4, 3])}
    assert gpu.largest_difference(ours, ours) == 0.0
    assert gpu.largest_difference(ours, {**ours, "a": np.array([1.5, -2.0])}) == pytest.approx(0.25)
    assert np.isnan(gpu.largest_difference(ours, {**ours, "a": np.array([1.0, np.nan])}))


SAY_CORES = "import os, json; print('noise'); print(json.dumps({'cores': sorted(os.sched_getaffinity(0))}))"


def test_processes_are_bound_before_they_start():
    launches = [Launch([sys.executable, "-c", SAY_CORES], [core]) for core in usable_cores()[:2]]
    assert [answer["cores"] for answer in answers(launches)] == [[core] for core in usable_cores()[:2]]


def test_a_process_that_fails_says_why():
    with pytest.raises(ProcessFailure, match=r"(?s)failed.*no such thing"):
        answers([Launch([sys.executable, "-c", "raise SystemExit('no such thing')"], usable_cores())])


def test_a_suite_is_its_parts_and_a_part_itself():
    assert [part.name for part in named("limit")] == ["limit-share", "limit-products"]
    assert [part.name for part in named("latency")] == ["latency"]
    with pytest.raises(InputError, match="no benchmark is called 'roofline'"):
        named("roofline")


@pytest.mark.parametrize(
    ("arguments", "name"),
    [(["roofline"], "roofline"), (["growth", "--only", "colour"], "colour"), (["gpu", "--quick"], "no GPU")],
)
def test_a_mistake_is_one_clear_line(capsys, arguments, name):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert name in error
    assert error.count("\n") == 1


def test_the_help_lists_everything(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    listed = capsys.readouterr().out
    assert all(f"  {name} " in listed for name in [*SUITES, *(part.name for part in PARTS)])


MACHINE = cache(machine)
QUICK = [["peers", "--only", "one seed, 1 core: csac SAC"], *([name] for name in SUITES if name != "peers")]


@pytest.mark.slow
@pytest.mark.parametrize("arguments", QUICK, ids=lambda arguments: arguments[0])
def test_every_benchmark_runs(arguments, monkeypatch, capsys):
    """Quickly, so that nothing is written, but a table is printed with the machine below, which is measured once."""
    monkeypatch.setattr("benchmarks.part.machine", MACHINE)
    assert main([*arguments, "--quick", "--device", "cpu", "--write"]) == 0
    printed = capsys.readouterr().out
    assert "| --- |" in printed
    assert "one core multiplies 256 x 256 x 256 at" in printed
    assert "not written: only a part of " in printed
