"""What README and the tutorials show runs, commands on all pages parse, and pages hold what the examples print."""

from __future__ import annotations

import importlib.util
import math
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
    assert len(re.findall(r"\S*\w\S*", page)) <= 1_100  # words
    assert len(re.findall(r"\d\.\d", page)) <= 25
    assert (ROOT / "results" / "film.gif").stat().st_size < 3e6


@pytest.mark.parametrize(("tau", "expected"), [(0.05, 0.9), (0.5, 0.9), (5.0, 5.0 / 5.2), (50.0, 50.0 / 50.2)])
def test_an_iteration_leaves_the_larger_of_alpha_and_the_discount(tau, expected):
    # Values shrink by γ = 0.9, advantages by α = τ / (τ + 0.2): 0.2, 0.71, 0.96 and 0.996.
    assert LAG.contraction(0.2, tau, 0.9) == pytest.approx(expected, abs=3e-3)


@pytest.mark.parametrize(
    ("choice", "lag"),
    [
        (LAG.Choice("average", rate=0.05), 20.0),
        (LAG.Choice("average", rate=1.0), 1.0),
        (LAG.Choice("periodic", period=1), 0.0),
    ],
)
def test_a_reference_slows_down_by_its_lag(choice, lag):
    # 0.01·0.5 / 0.5² = 0.02 of the way back to the reference in each update: 1 + 0.02 x lag times as long.
    assert LAG.predicted_slow_down(choice, 0.02) == pytest.approx(1 + 0.02 * lag)
    measured = LAG.measured_slow_down(choice, 0.5, 0.5, optax.sgd(0.01), updates=600)
    assert measured == pytest.approx(1 + 0.02 * lag, rel=1e-3)


@pytest.mark.parametrize(("tau", "lag"), [(0.25, 49.5), (50.0, 100.0)])
def test_a_period_lags_by_half_of_it_and_by_all_of_it_where_it_holds_fast(tau, lag):
    choice, resistance = LAG.Choice("periodic", period=100), 0.001 * tau / 0.5**2
    expected = 1 + resistance * lag if tau < 1 else resistance * lag
    assert LAG.predicted_slow_down(choice, resistance) == pytest.approx(expected, rel=1e-3)
    measured = LAG.measured_slow_down(choice, tau, 0.5, optax.sgd(0.001), updates=800)
    assert measured == pytest.approx(expected, rel=1e-3)


NEAR_THE_END = [LAG.Choice("average", rate=1.0), LAG.Choice("average", rate=0.05), LAG.Choice("periodic", period=20)]


@pytest.mark.parametrize("choice", [LAG.Choice("periodic", period=1), *NEAR_THE_END])
@pytest.mark.parametrize("tau", [0.5, 5.0])
def test_half_of_the_distance_is_gone_when_theory_says_so(choice, tau):
    weights = LAG.Weights(0.2, tau)  # τ = 0.5 lengthens the way at a rate of 1 by 2 %, and with the others by more
    predicted = LAG.predicted_half_life(choice, weights, 0.5, 0.01)
    assert LAG.measured_half_life(choice, weights, 0.5, 0.01) == pytest.approx(predicted, rel=0.01)


@pytest.mark.parametrize(("choice", "lag"), zip(NEAR_THE_END, (1.0, 20.0, 9.5), strict=True))
def test_a_short_lag_adds_itself_times_tau_by_sigma(choice, lag):
    # An update goes 1e-4·0.2 / 0.5² = 1 / 12,500 of the way by itself; τ / σ is 25.
    by_itself = LAG.predicted_half_life(LAG.Choice("periodic", period=1), LAG.Weights(0.2, 0.0), 0.5, 1e-4)
    longer = LAG.predicted_half_life(choice, LAG.Weights(0.2, 5.0), 0.5, 1e-4) - by_itself
    assert longer == pytest.approx(math.log(2) * 25 * lag, rel=0.03)


def test_a_long_lag_is_a_refresh():
    # Where the policy is done long before its reference is renewed, each renewal leaves α = 0.5 / 0.7 of the distance.
    weights, refreshes = LAG.Weights(0.2, 0.5), math.log(0.5) / math.log(0.5 / 0.7)
    periodic = LAG.predicted_half_life(LAG.Choice("periodic", period=5000), weights, 0.5, 0.01)
    assert periodic == pytest.approx(5000 * refreshes, rel=1e-6)
    # A running average is renewed all the time: 1 - α of the way in every 1 / rate updates.
    average = LAG.predicted_half_life(LAG.Choice("average", rate=1e-6), weights, 0.5, 0.01)
    assert average == pytest.approx(1e6 * math.log(2) * 0.7 / 0.2, rel=1e-3)


@pytest.mark.parametrize("choice", NEAR_THE_END)
def test_beyond_its_limit_a_step_back_is_larger_than_the_one_before(choice):
    def steps(share):
        tau = share * LAG.largest_stable_resistance(choice) * 0.5**2 / 0.01
        way = LAG.means(choice, LAG.Weights(0.0, tau), 0.5, optax.sgd(0.01), 40, LAG.even_pull)
        return np.abs(np.diff(np.asarray(way)))[-20:]  # one period

    stable, unstable = steps(0.9), steps(1.1)
    assert stable.max() < 2e-4  # of 1e-4 that Q alone moves it
    assert unstable[-1] > 3 * unstable[1] > 0


@pytest.mark.parametrize(
    ("choice", "lag"),
    [
        (LAG.Choice("average", rate=1.0), 1.0),
        (LAG.Choice("average", rate=0.05), 20.0),
        (LAG.Choice("periodic", period=50), 50.0),
    ],
)
def test_adam_without_noise_goes_at_full_speed_until_the_reference_pulls_as_hard(choice, lag):
    # The pull is 0.01, and a step of 3e-4 against 1 / 0.5² = 4: with τ L = 100 the way takes 3e-4·4·100 / 0.01 = 12
    # times as long, and with τ L = 5 no longer than without.
    for product, expected in ((100.0, 12.0), (5.0, 1.0)):
        tau = product / lag
        assert LAG.predicted_slow_down_with_adam(choice, tau, 0.5, 3e-4, 0.0) == pytest.approx(expected)
        measured = LAG.measured_slow_down(choice, tau, 0.5, optax.adam(3e-4), 4_000)
        assert measured == pytest.approx(expected, rel=0.07), product  # at a rate of 1 it goes to and fro as well


@pytest.mark.parametrize(
    ("choice", "tau", "expected"),
    [
        # 3e-4 / 0.1 x 5 / 0.5² = 0.06 of the way back in each update, and a lag of 20.
        (LAG.Choice("average", rate=0.05), 5.0, 1 + 0.06 * 20),
        # 0.015 of it, and a period leaves 0.985^200 = 0.0487. (Adam's mean of ten gradients reaches into the next one.)
        (LAG.Choice("periodic", period=200), 1.25, 200 * 0.015 / (1 - 0.0487)),
    ],
)
def test_adam_in_noise_is_descent_with_the_rate_over_the_noise(choice, tau, expected):
    assert LAG.predicted_slow_down_with_adam(choice, tau, 0.5, 3e-4, 0.1) == pytest.approx(expected, rel=1e-3)
    measured = LAG.measured_slow_down(choice, tau, 0.5, optax.adam(3e-4), 100_000, 0.1)
    assert measured == pytest.approx(expected, rel=0.06)


@pytest.mark.parametrize("std", [1.0, 0.1, 0.01])
def test_only_noise_is_left_of_a_sampled_relative_entropy_towards_the_actor_itself(std):
    exact, sampled = (
        READING.gradients(
            READING.CSAC(relative_entropy_estimator=estimator, reference_policy="periodic", reference_period=1), std
        )
        for estimator in ("closed_form", "sampled")
    )
    mean, deviation = READING.moments(sampled - exact)
    # d/dμ of 0.5 log(π/π̃) at a = tanh(μ + std ξ) is that of the log-density in its first argument, 0.5 ξ / std.
    assert mean == pytest.approx(0.0, abs=1e-3 / std)
    assert deviation == pytest.approx(0.5 / std, rel=1e-3)
    without = READING.gradients(READING.CSAC(relative_entropy_weight=0.0), std)
    np.testing.assert_allclose(exact, without, atol=1e-6 / std)


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
