"""What all benchmarks share: turns, rows and tables in files, processes, and the command line."""

from __future__ import annotations

import re
import sys
from typing import Any, NamedTuple

import pytest

from benchmarks import dispatch
from benchmarks.__main__ import PARTS, SUITES, main, named
from benchmarks.measuring import ROOT, Process, run, surroundings
from benchmarks.parts import Options, Part
from benchmarks.suites import gpu, growth
from benchmarks.tables import Row, formatted, read_rows, write_rows
from csac import CSAC
from csac.presets import hyperparameters
from csac.processes import usable_cores
from csac.record.rendering import between_markers
from csac.types import InputError


class Case(NamedTuple):
    name: str
    repeated: bool = True


def part(**changes) -> Part:
    given = {"cases": ["a", "b"], "measure": lambda case, options: [{"case": case, "speed": 1.5}]}
    return Part(**{"name": "it", "page": "page.md", "about": "", "render": {"of": "{case}"}, **given, **changes})


def test_cases_take_turns_and_some_come_once():
    cases = [Case("a"), Case("b", repeated=False), Case("c")]
    rows = part(cases=cases, measure=lambda case, _: [{"case": case.name}], repetitions=2).run(Options())

    assert [(row["repetition"], row["case"]) for row in rows] == [(0, "a"), (0, "b"), (0, "c"), (1, "a"), (1, "c")]
    once = part(repetitions=2).run(Options(repetitions=1))
    assert [(row["repetition"], row["case"]) for row in once] == [(0, "a"), (0, "b")]


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (Options(), ["a", "b"]),
        (Options(only="b"), ["b"]),
        (Options(only="nothing"), []),
        (Options(quick=True), ["a"]),
        (Options(repetitions=2), ["a", "b"]),  # what is measured once has no column for more
    ],
)
def test_which_cases_are_measured(options, expected):
    assert [row["case"] for row in part().run(options)] == expected


def test_what_is_measured_outlives_what_cuts_it_off(tmp_path):
    def measure(case: str, _: Options) -> list[Row]:
        if case == "b":
            raise RuntimeError("the machine is gone")
        return [{"case": case, "speed": 2.5}]

    unfinished = part().unfinished(tmp_path)
    with pytest.raises(RuntimeError, match="the machine is gone"):
        part(measure=measure).run(Options(), unfinished)
    assert read_rows(unfinished) == [{"case": "a", "speed": 2.5}]
    rows = part().run(Options(), unfinished)
    assert read_rows(unfinished) == rows  # until they lie where they belong
    part().write(rows, [], tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["it.csv", "it.txt"]


def test_what_pages_measure_alone_is_there():
    cases = [getattr(case, "name", case) for part in PARTS for case in part.cases]
    pages = (*ROOT.glob("docs/**/*.md"), ROOT / "benchmarks" / "README.md")
    wanted = [text for page in pages for text in re.findall(r"""ARGS='.*--only "(.+?)\"""", page.read_text())]
    assert wanted
    assert [text for text in wanted if not any(text in case for case in cases)] == []


def test_a_window_that_is_evaluated_holds_an_interval():
    assert Options().window(5.0)[2:] == (5.0, 1, 0, 10)
    assert Options().window(0.0, evaluated=True)[2:] == (0.0, 5_000, 5_000, 10)
    assert Options(seconds=2.0).window(5.0).seconds == 2.0
    assert Options(quick=True).window(5.0, evaluated=True)[2:] == (1.0, 250, 250, 1)


def test_rows_come_back_as_they_were_written(tmp_path):
    rows = [{"task": "Ant-v4, whole", "steps": 1_000_000, "speed": 1234.5, "share": 0.25, "aim": ""}]
    write_rows(tmp_path / "rows.csv", rows)

    assert read_rows(tmp_path / "rows.csv") == rows


def test_a_format_names_columns_of_the_row():
    rows = [{"task": "Ant", "speed": 1234.5, "share": 0.256}]

    assert formatted(rows, {"task": "{task}", "steps/s (share)": "{speed:,.1f} ({share:.0%})"}).splitlines() == [
        "| task | steps/s (share) |",
        "| --- | --- |",
        "| Ant | 1,234.5 (26%) |",
    ]


def test_a_table_goes_between_its_own_markers():
    page = "<!-- a: begin -->\n<!-- a: end -->\n<!-- b: begin -->\nold\n<!-- b: end -->\nafter\n"

    new = between_markers(page, "b", "new\n")
    assert new == "<!-- a: begin -->\n<!-- a: end -->\n<!-- b: begin -->\nnew\n<!-- b: end -->\nafter\n"
    with pytest.raises(ValueError, match="lacks the lines <!-- c: begin -->"):
        between_markers(page, "c", "new\n")


def test_what_is_written_is_what_the_page_shows(tmp_path):
    (tmp_path / "page.md").write_text("<!-- it: begin -->\nold\n<!-- it: end -->\n")
    measured = part()

    measured.publish(tmp_path, tmp_path)
    assert "Not measured yet: `python -m benchmarks it --write`" in (tmp_path / "page.md").read_text()
    measured.write(measured.run(Options()), ["a machine"], tmp_path)
    measured.publish(tmp_path, tmp_path)
    table = "| of |\n| --- |\n| a |\n| b |\n\n- a machine\n"
    assert (tmp_path / "page.md").read_text() == f"<!-- it: begin -->\n{table}<!-- it: end -->\n"


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_the_committed_tables_follow_from_their_rows(part: Part):
    page = (ROOT / part.page).read_text()

    assert between_markers(page, part.name, part.block()) == page, "run `python -m benchmarks render`"


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.name)
def test_every_measured_table_names_its_machine(part: Part):
    block = part.block()

    assert "Not measured yet" in block or ("- processor: " in block and " 256 x 256 x 256 " in block)


def test_growth_compares_each_point_with_the_one_before():
    points = [(128, 200.0, 2.0), (256, 100.0, 8.0)]
    rows = [
        {"axis": "width", "value": value, "updates_per_second": speed, "peak_mib": 1500.0, "giga_operations": cost}
        for value, speed, cost in points
    ]

    assert growth.render(rows).splitlines()[2:] == [
        "| 128 | 200 | 5.00 | 400 |  | 1,500 |",
        "| 256 | 100 | 10.00 | 800 | 2.00 (4.00) | 1,500 |",
    ]


def test_only_the_paper_s_updates_in_strict_order_have_an_aim():
    measured = {"device": "a GPU", "steps_per_second": 9_000.0, "start_seconds": 1.0, "peak_mib": 1.0, "processes": 1}
    cases = [("paper", 1), ("paper", 10), ("strong", 1)]
    rows = [
        {**measured, "preset": preset, "seeds": seeds, "updates_in_one_dispatch": each}
        for preset, each in cases
        for seeds in (1, 5)
    ]

    table = [[cell.strip() for cell in line.split("|")] for line in gpu.render_speed(rows).splitlines()[2:]]
    assert [(line[2], line[3], line[5], line[7]) for line in table] == [
        ("paper", "1", "1", ""),
        ("paper", "5", "1", "10,000"),
        ("paper", "1", "10", ""),
        ("paper", "5", "10", ""),
        ("strong", "1", "1", ""),
        ("strong", "5", "1", ""),
    ]


def test_the_picture_of_growth_has_its_axes(tmp_path):
    growth.draw(read_rows(ROOT / "benchmarks" / "results" / "growth.csv"), tmp_path / "growth.png")

    assert (tmp_path / "growth.png").read_bytes().startswith(b"\x89PNG")


SAY_CORES = "import os, json; print('noise'); print(json.dumps({'cores': sorted(os.sched_getaffinity(0))}))"


def test_processes_are_bound_before_they_start():
    processes = [Process([sys.executable, "-c", SAY_CORES], [core]) for core in usable_cores()[:2]]

    assert [answer["cores"] for answer in run(processes, surroundings("cpu"))] == [
        [core] for core in usable_cores()[:2]
    ]


def test_processes_that_run_together_wait_for_each_other():
    wait = "print('ready', flush=True); line = input(); print('{\"line\": \"%s\"}' % line)"
    process = Process([sys.executable, "-c", wait], usable_cores())

    assert run([process, process], surroundings("cpu"), together=True) == [{"line": "go"}, {"line": "go"}]


def test_a_process_that_fails_says_why():
    process = Process([sys.executable, "-c", "raise SystemExit('no such thing')"], usable_cores())

    with pytest.raises(RuntimeError, match=r"(?s)a measurement failed.*no such thing"):
        run([process], surroundings("cpu"))


def test_a_suite_is_its_parts_and_a_part_itself():
    assert [part.name for part in named("limit")] == ["limit-share", "limit-products", "limit-operations"]
    assert [part.name for part in named("time-loop")] == ["time-loop"]
    assert {part.name for suite in SUITES for part in named(suite)} == {part.name for part in PARTS}
    with pytest.raises(InputError, match="nothing called 'roofline'"):
        named("roofline")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["roofline"], "nothing called 'roofline' to measure: choose among peers, limit"),
        (["growth", "--only", "colour"], "nothing in growth can be measured here whose name contains 'colour'"),
        (["gpu", "--quick"], "no GPU that JAX can use: pip install '.[cuda]' in a clone of csac"),
    ],
)
def test_a_mistake_is_one_clear_line(capsys, arguments, complaint):
    assert main(arguments) == 2

    error = capsys.readouterr().err
    assert complaint in error
    assert error.count("\n") == 1


def test_the_help_lists_everything(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])

    listed = capsys.readouterr().out
    assert all(f"  {name} " in listed for name in [*SUITES, *(part.name for part in PARTS), "render"])


QUICK = [
    ["peers", "--only", "one seed, 1 core: csac SAC"],
    *([part.name] for part in PARTS if part.name not in ("peers", "gpu-agreement")),
]


@pytest.mark.slow
@pytest.mark.parametrize("arguments", QUICK, ids=lambda arguments: arguments[0])
def test_every_part_runs(arguments, capsys):
    """Quickly, and as a part of it: nothing is written, but a table is printed with the machine below."""
    assert main([*arguments, "--quick", "--seconds", "0.1", "--device", "cpu", "--write"]) == 0

    printed = capsys.readouterr().out
    assert "| --- |" in printed
    assert "one core multiplies 256 x 256 x 256 at" in printed
    assert f"not written: only a part of {arguments[0]} was measured" in printed


def test_the_default_that_is_compared_is_csac_s():
    compared: dict[str, Any] = hyperparameters("paper", "csac", "HalfCheetah-v4") | dict(dispatch.DEFAULT)
    assert CSAC(**compared) == CSAC()


def test_one_measurement_is_too_few_for_a_middle_half(capsys):
    with pytest.raises(SystemExit) as ended:
        dispatch.main(["critics", "--rounds", "1", "--repetitions", "1"])
    assert ended.value.code == 2
    assert "must be at least 2" in capsys.readouterr().err
