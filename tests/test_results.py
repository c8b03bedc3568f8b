"""Every table in results/ follows from the rows beside it: the commands in a page write the tables that stand there."""

import csv
import re
import runpy
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

import pytest
from chaos import MARKERS, Kill, summary

from csac.cli import main

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "results").glob("**/README.md"))
TABLE = re.compile(r"^\|.*\|\n\| ?:?---", re.MULTILINE)


def commands(page: Path) -> list[list[str]]:
    """The words of each `csac report` that a page names."""
    blocks = "\n".join(re.findall(r"^```sh\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL))
    lines = blocks.replace("\\\n", " ").splitlines()
    return [words[1:] for words in map(shlex.split, lines) if words[:2] == ["csac", "report"]]


# The tables that evidence.py writes, by the folders of their pages.
EVIDENCE = {
    "reference": ["fresh", "ant", "recovery", "screen", "stage-0", "stage-0-fresh"],
    "strong": ["primary", "whose", "stage-1", "aims", "pieces", "leaner", "longer", "again"],
}
WITH_COMMANDS = [page for page in PAGES if commands(page)]


@pytest.fixture
def copied(tmp_path, monkeypatch):
    """A copy of the rows and pages, without the pictures."""
    shutil.copytree(ROOT / "results", tmp_path / "results", ignore=shutil.ignore_patterns("*.png"))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", WITH_COMMANDS, ids=lambda page: page.parent.name)
def test_the_commands_of_a_page_write_its_tables(copied, page):
    there = copied / page.relative_to(ROOT)
    others = [*EVIDENCE.get(page.parent.name, []), "equal-time"]  # which other commands write, and other tests
    emptied = re.sub(
        r"(<!-- (\S+): begin -->\n)(.*?)(<!-- \2: end -->)",
        lambda found: found[0] if found[2] in others else found[1] + found[4],
        page.read_text(),
        flags=re.DOTALL,
    )
    there.write_text(emptied)
    for words in commands(page):
        if "--curve" in words:  # which would take a second each, and is another's test
            place = words.index("--curve")
            del words[place : place + 2]
        assert main(words) == 0
    assert there.read_text() == page.read_text()


STUDIED = sorted((ROOT / "results" / "studies").glob("*/report.md"))


@pytest.mark.parametrize("page", STUDIED, ids=lambda page: page.parent.name)
def test_the_command_of_a_study_s_report_writes_it(copied, page):
    (line,) = re.findall(r"^csac (study report .*)$", page.read_text(), re.MULTILINE)
    there = copied / page.parent.relative_to(ROOT)
    shutil.rmtree(there)
    assert main(shlex.split(line)) == 0
    assert (there / "report.md").read_text() == page.read_text()
    assert {path.name for path in there.glob("*.svg")} == {path.name for path in page.parent.glob("*.svg")}


def test_the_table_of_the_relative_entropy_follows_from_its_runs(copied, monkeypatch, capsys):
    script = copied / "results" / "reference" / "mechanism.py"
    monkeypatch.setattr(sys, "argv", [str(script), "draw"])
    runpy.run_path(str(script), run_name="__main__")
    tables = capsys.readouterr().out.strip().split("\n\n")
    assert [table.count("\n") > 10 for table in tables] == [True, True]
    document = (ROOT / "docs" / "relative-entropy.md").read_text()
    assert all(f"\n{table}\n" in document for table in tables)
    assert (script.parent / "mechanism.png").stat().st_size > 10_000


@pytest.mark.parametrize("document", ["README.md", "docs/algorithms/critics.md"])
def test_what_documents_tell_of_the_preset_strong_stands_in_its_tables(document):
    tables = (ROOT / "results" / "strong" / "README.md").read_text().partition("<!-- whose: begin -->")[2]
    told = (ROOT / document).read_text().replace("95 % interval ", "")
    returns = re.findall(r"[\d,]+\.\d ± [\d,]+\.\d", told)
    assert len(returns) == 15
    assert all(f"| {one} |" in tables for one in returns)
    for pair in (
        "CSAC, candidate | SAC, automatic",
        "SAC, candidate | SAC, automatic",
        "CSAC, candidate | **SAC, candidate**",
    ):
        probability = re.search(rf"^\| {re.escape(pair)} \| (.*?) \|", tables, re.MULTILINE)
        assert probability is not None
        assert probability[1] in told


@pytest.mark.parametrize(("name", "tables"), EVIDENCE.items(), ids=EVIDENCE)
def test_the_tables_of_the_evidence_follow_from_its_cells(copied, monkeypatch, name, tables):
    page = copied / "results" / name / "README.md"
    before = page.read_text()
    emptied = before
    for table in tables:
        marks = rf"(<!-- {table}: begin -->\n).*?(<!-- {table}: end -->)"
        emptied, count = re.subn(marks, r"\1\2", emptied, flags=re.DOTALL)
        assert count == 1
    page.write_text(emptied)
    lines = re.findall(r"^python (results/reference/evidence.py tables .*)$", before, re.MULTILINE)
    assert len(lines) == len(tables)
    for line in lines:
        monkeypatch.setattr(sys, "argv", shlex.split(line))
        runpy.run_path(sys.argv[0], run_name="__main__")
    assert page.read_text() == before


def test_the_tables_of_equal_time_follow_from_its_files(copied, monkeypatch):
    page = copied / "results" / "strong" / "README.md"
    before = page.read_text()
    emptied, count = re.subn(
        r"(<!-- equal-time: begin -->\n).*?(<!-- equal-time: end -->)", r"\1\2", before, flags=re.DOTALL
    )
    assert count == 1
    page.write_text(emptied)
    (line,) = re.findall(r"^python (results/strong/equal_time.py .*)$", before, re.MULTILINE)
    monkeypatch.setattr(sys, "argv", shlex.split(line))
    runpy.run_path(sys.argv[0], run_name="__main__")
    assert page.read_text() == before
    assert (copied / "results" / "strong" / "equal-time.png").exists()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_no_table_of_numbers_is_written_by_hand(page):
    """What stands between markers is written by a command; any other table may only list files and commands."""
    text = re.sub(r"<!-- (\S+): begin -->.*?<!-- \1: end -->", "", page.read_text(), flags=re.DOTALL)
    text = re.sub(f"{MARKERS[0]}.*?{MARKERS[1]}", "", text, flags=re.DOTALL)
    headings = [match.group().splitlines()[0] for match in TABLE.finditer(text)]
    assert set(headings) <= {"| file | command |"}


def test_the_table_of_kills_follows_from_its_rows():
    folder = ROOT / "results" / "reliability"
    with open(folder / "chaos.csv", newline="") as file:
        kills = [Kill(**{name: _value(row.get(name, "")) for name in Kill._fields}) for row in csv.DictReader(file)]
    assert f"{MARKERS[0]}\n{summary(kills)}\n{MARKERS[1]}" in (folder / "README.md").read_text()


def _value(text: str) -> Any:
    return int(text) if text.lstrip("-").isdecimal() else text or None


@pytest.mark.parametrize(
    ("name", "mark", "pair", "documents"),
    [
        ("strong", "stage-1", "CSAC, paper | SAC, automatic", []),
        ("strong", "aims", "CSAC, candidate | SAC, automatic", ["README.md", "docs/algorithms/critics.md"]),
        ("strong", "aims", "CSAC, candidate | **SAC, candidate**", ["README.md", "docs/algorithms/critics.md"]),
        ("strong", "aims", "SAC, candidate | SAC, automatic", ["README.md", "docs/algorithms/critics.md"]),
        ("strong", "longer", "CSAC, candidate | **SAC, candidate**", ["docs/algorithms/critics.md"]),
        ("strong", "again", "CSAC, candidate | **SAC, candidate**", []),
        ("reference", "fresh", "CSAC, paper | **SAC, 0.2**", ["README.md"]),
        ("reference", "fresh", "CSAC, paper | SAC, automatic", []),
        ("reference", "fresh", "CSAC, previous | **SAC, 0.2**", ["README.md", "docs/design.md"]),
        ("reference", "fresh", "CSAC, average 0.05 | **SAC, 0.2**", ["README.md", "docs/design.md"]),
        ("reference", "fresh", "CSAC, average 0.05 | SAC, automatic", ["README.md"]),
        ("reference", "ant", "CSAC, paper | **SAC, 0.2**", ["README.md"]),
        ("reference", "ant", "CSAC, previous | **SAC, 0.2**", ["README.md"]),
        ("reference", "ant", "CSAC, average 0.05 | **SAC, 0.2**", ["README.md"]),
        ("reference", "recovery", "CSAC, previous | **SAC, 0.2**", []),
        ("reference", "recovery", "CSAC, average 0.05 | **SAC, 0.2**", []),
    ],
)
def test_what_documents_tell_of_a_comparison_stands_in_its_table(name, mark, pair, documents):
    page = f"results/{name}/README.md"
    table = (ROOT / page).read_text().partition(f"<!-- {mark}: begin -->")[2].partition(f"<!-- {mark}: end -->")[0]
    row = re.search(rf"^\| {re.escape(pair)} \| (.*?) \| .*? \| (.*?) \|", table, re.MULTILINE)
    assert row is not None
    for document in [*documents, page]:
        assert row[1] in _prose(document).replace("95 % interval ", "")
    if pair.startswith("CSAC, previous | **"):  # of whose steadiness and recovery the verdict tells too
        assert row[2] in _prose("README.md")
        assert row[2] in _prose(page)


def _prose(document: str) -> str:
    """Return a document without what commands have written into it."""
    return re.sub(r"<!-- (\S+): begin -->.*?<!-- \1: end -->", "", (ROOT / document).read_text(), flags=re.DOTALL)
