"""What README and the tutorials show runs, commands on all pages parse, and pages hold what the examples print."""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import nbformat
import numpy as np
import optax
import pytest
from nbclient import NotebookClient

import csac.studies.commands as study_commands
from csac.cli.commands import COMMANDS
from csac.cli.options import parse_training
from csac.cli.parsing import parse

ROOT = Path(__file__).parents[1]
LAG = SimpleNamespace(**runpy.run_path(str(ROOT / "examples" / "reference_lag.py")))
READING = SimpleNamespace(**runpy.run_path(str(ROOT / "examples" / "minibatch_reading.py")))
NUMBER = re.compile(r"[-+]?\d+\.?\d*")
BLOCK = re.compile(r"^```(sh|python)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
# Numbers on a page and here.
SHORT = {
    "10000": "350",
    "20000": "350",
    "8000": "330",
    "6000": "300",
    "1000": "300",
    "500": "250",
    "100": "20",
    "50": "4",
}
TUTORIALS = sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("docs/tutorials/*.md"))
NOTEBOOK = ROOT / "examples" / "first_controller.ipynb"


@pytest.mark.slow
@pytest.mark.parametrize("page", ["README.md", *TUTORIALS])
def test_what_a_page_shows_runs(page, tmp_path):
    """A block whose first line is `# name.py` is also saved under that name."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    blocks = BLOCK.findall((ROOT / page).read_text())
    assert "python" in {language for language, _ in blocks}
    for language, block in blocks:
        text = re.sub(r"\b\d[\d_]*\b", lambda found: SHORT.get(found[0].replace("_", ""), found[0]), block)
        if importlib.util.find_spec("pygame") is None:  # draws Pendulum
            text = re.sub("^csac play .*$", "", text, flags=re.MULTILINE)
        if named := re.match(r"# (\w+\.py)\n", text):
            (tmp_path / named[1]).write_text(text)
        command = ["bash", "-ec", text] if language == "sh" else [sys.executable, "-c", text]
        done = subprocess.run(
            command, cwd=tmp_path, env=os.environ | {"PATH": path}, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{text}\n{done.stdout}\n{done.stderr}"


@pytest.mark.slow
def test_the_notebook_runs_and_draws(tmp_path):
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    for cell in notebook.cells:
        cell.source = cell.source.replace("STEPS = 8_000", "STEPS = 330").replace("1_000", "300")
    NotebookClient(notebook, timeout=600, kernel_name="python3", resources={"metadata": {"path": tmp_path}}).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 5


PAGES = ["README.md", *sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("docs/**/*.md"))]
VARIABLE = re.compile(r"^(TASK|DIR|OTHER|FILE|FIRST|NAME|RUN)\b|\$|\.\.\.|^on$")  # to be replaced, or printed


@pytest.mark.parametrize("page", PAGES)
def test_python_compiles_and_commands_parse(page, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples")
    for language, block in re.findall(r"^```(\w*)\n(.*?)^```$", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE):
        if language == "python":
            compile(block, page, "exec")
        elif language in ("", "sh"):
            for line in block.replace("\\\n", " ").splitlines():
                words = shlex.split(line, comments=True) if line.lstrip().startswith("csac ") else []
                if words and not any(map(VARIABLE.search, words)) and "--from" not in words:
                    parsed(words[1], words[2:])


def parsed(name: str, words: list[str]) -> object:
    """Return the options of a command. Raises InputError for one that there is not."""
    if name in ("study", "report"):
        kind = study_commands.COMMANDS[words.pop(0)][0] if name == "study" else study_commands.Report
        return parse(kind, words, f"csac {name}")
    kind = COMMANDS[name][0]
    return (parse_training if name in ("train", "tune") else parse)(kind, words, f"csac {name}")


def test_the_front_page_is_read_in_minutes():
    page = (ROOT / "README.md").read_text()
    assert len(re.findall(r"\S*\w\S*", page)) <= 1_000  # words
    assert len(re.findall(r"\d\.\d", page)) <= 25
    assert (ROOT / "results" / "film.gif").stat().st_size < 3e6


@pytest.mark.parametrize(("tau", "expected"), [(0.05, 0.9), (0.5, 0.9), (5.0, 5.0 / 5.2), (50.0, 50.0 / 50.2)])
def test_an_iteration_leaves_the_larger_of_alpha_and_the_discount(tau, expected):
    # Values shrink by γ = 0.9, advantages by α = τ / (τ + 0.2): 0.2, 0.71, 0.96 and 0.996.
    assert LAG.contraction(0.2, tau, 0.9) == pytest.approx(expected, abs=3e-3)


@pytest.mark.parametrize(
    ("choice", "lag"),
    [(LAG.Choice("average", rate=0.05), 20.0), (LAG.Choice("periodic", period=1), 0.0)],
)
def test_a_reference_slows_down_by_its_lag(choice, lag):
    # 0.01·0.5 / 0.5² = 0.02 of the way back to the reference in each update: 1 + 0.02 x lag times as long.
    assert LAG.predicted_slow_down(choice, 0.02) == pytest.approx(1 + 0.02 * lag)
    measured = LAG.measured_slow_down(choice, 0.5, 0.5, optax.sgd(0.01), updates=600)
    assert measured == pytest.approx(1 + 0.02 * lag, rel=1e-3)


NEAR_THE_END = [LAG.Choice("average", rate=1.0), LAG.Choice("average", rate=0.05), LAG.Choice("periodic", period=20)]


@pytest.mark.parametrize(("choice", "tau"), zip(NEAR_THE_END, (0.5, 5.0, 5.0), strict=True))
def test_half_of_the_distance_is_gone_when_theory_says_so(choice, tau):
    weights = LAG.Weights(0.2, tau)  # τ = 0.5 lengthens the way at a rate of 1 by 2 %, and with the others by more
    predicted = LAG.predicted_half_life(choice, weights, 0.5, 0.01)
    assert LAG.measured_half_life(choice, weights, 0.5, 0.01) == pytest.approx(predicted, rel=0.01)


@pytest.mark.parametrize("choice", NEAR_THE_END[1:])
def test_beyond_its_limit_a_step_back_is_larger_than_the_one_before(choice):
    def steps(share):
        tau = share * LAG.largest_stable_resistance(choice) * 0.5**2 / 0.01
        way = LAG.means(choice, LAG.Weights(0.0, tau), 0.5, optax.sgd(0.01), 40, LAG.even_pull)
        return np.abs(np.diff(np.asarray(way)))[-20:]  # one period

    stable, unstable = steps(0.9), steps(1.1)
    assert stable.max() < 2e-4  # of 1e-4 that Q alone moves it
    assert unstable[-1] > 3 * unstable[1] > 0


@pytest.mark.parametrize(
    "example", [pytest.param(LAG, marks=pytest.mark.slow), READING], ids=["reference_lag", "minibatch_reading"]
)
def test_a_page_holds_what_an_example_prints(example, capsys):
    example.main()
    told = (ROOT / "results" / "reference" / "mechanism.md").read_text()
    for table in capsys.readouterr().out.strip().split("\n\n"):
        heading, *_ = table.splitlines()
        held = told[told.index(f"```\n{heading}\n") + 4 :].partition("\n```")[0]
        assert NUMBER.sub("", held).split() == NUMBER.sub("", table).split()
        printed, written = (np.array(NUMBER.findall(text), float) for text in (table, held))
        np.testing.assert_allclose(printed, written, rtol=0.03, atol=2e-3)
