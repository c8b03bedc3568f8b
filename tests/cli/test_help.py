"""The help."""

from __future__ import annotations

import dataclasses
import re

import pytest
from typed import COMMANDS, csac

from csac.algorithms import ALGORITHMS


def test_help_lists_the_commands(capsys):
    assert csac("") == 0
    assert csac("--help") == 0

    output = capsys.readouterr().out
    for command in COMMANDS:
        assert output.count(f"  csac {command} ") == 2


@pytest.mark.parametrize("words", ["train", "study show", "resume"])
def test_help_before_a_command_is_the_help_of_it(capsys, words):
    assert csac(f"help {words}") == 0
    assert capsys.readouterr().out.startswith(f"usage: csac {words} ")


def test_version(capsys):
    assert csac("--version") == 0
    assert capsys.readouterr().out == "csac 0.1.0\n"


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_the_help_of_train_explains_every_hyperparameter(capsys, monkeypatch, name):
    monkeypatch.setenv("COLUMNS", "100")  # wider, and the options stand in two columns

    assert csac(f"train --help --algorithm {name}") == 0

    box = capsys.readouterr().out.partition(f" {name} options")[2]
    shown = re.sub(r", --no-\S+", "", " ".join(line.strip("│ ") for line in box.splitlines()))
    for item in dataclasses.fields(ALGORITHMS[name]):
        option = "--" + item.name.replace("_", "-")
        explanation = shown.partition(f"{option} ")[2].partition(" --")[0]
        assert "(default: " in explanation
        assert len(explanation.partition("(default")[0].split()) > 3


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("train", "Kinds: factors on friction, gravity, mass or gain of a MuJoCo"),
        ("export", "as a share of its range; the fallback is then the last action, unless another is given."),
        ("study run", "one cell per worker at a time. ray: as many as a Ray cluster has room for (docs/cluster.md)."),
        ("study run", "each finished cell to this directory: all that a report needs. Cells copied there"),
    ],
)
def test_a_long_explanation_breaks_off_nowhere(capsys, monkeypatch, command, words):
    monkeypatch.setenv("COLUMNS", "2000")  # tyro would break it where its docstring goes on in another line

    csac(f"{command} --help")

    assert words in capsys.readouterr().out


def test_the_help_shows_what_a_preset_sets(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")

    csac("train --algorithm sac --preset paper --help")

    output = " ".join(capsys.readouterr().out.split())
    assert "(default: 0.2)" in output
    assert "(default: paper)" in output


@pytest.mark.parametrize("command", ["train", "tune"])
@pytest.mark.parametrize(("task", "weight"), [("PyFlyt/QuadX-Waypoints-v1", 0.1), ("Hopper-v4", 0.5), ("", 0.5)])
def test_the_help_shows_what_a_preset_sets_for_the_task(capsys, monkeypatch, command, task, weight):
    monkeypatch.setenv("COLUMNS", "100")

    csac(f"{command} {task} --preset paper --help")

    output = " ".join(line.strip("│ ") for line in capsys.readouterr().out.splitlines())
    assert f"(default: {weight})" in output.partition("--relative-entropy-weight ")[2].partition(" --")[0]


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("evaluate", ["--seed", "--episodes", "--stochastic", "--perturb KIND=VALUE"]),
        ("play", ["--seed", "--episodes", "--video", "--perturb KIND=VALUE"]),
    ],
)
def test_the_other_commands_have_help(capsys, command, options):
    assert csac(f"{command} --help") == 0

    output = capsys.readouterr().out
    assert all(option in output for option in [*options, "DIR"])
