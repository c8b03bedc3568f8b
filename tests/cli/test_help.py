"""The help."""

from __future__ import annotations

import dataclasses
import re

import pytest
from typed import COMMANDS, csac

from csac.algorithms import ALGORITHMS


def test_help_lists_the_commands(capsys):
    assert csac("") == csac("--help") == 0
    output = capsys.readouterr().out
    assert all(output.count(f"  csac {command} ") == 2 for command in COMMANDS)


@pytest.mark.parametrize("words", [*COMMANDS, "study show"])
def test_each_command_has_a_help(capsys, words):
    assert csac(f"{words} --help") == 0
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


@pytest.mark.parametrize("command", ["train", "tune"])
@pytest.mark.parametrize(("task", "weight"), [("PyFlyt/QuadX-Waypoints-v1", 0.1), ("Hopper-v4", 0.5), ("", 0.5)])
def test_the_help_shows_what_a_preset_sets_for_the_task(capsys, monkeypatch, command, task, weight):
    monkeypatch.setenv("COLUMNS", "100")
    csac(f"{command} {task} --preset paper --help")
    output = " ".join(line.strip("│ ") for line in capsys.readouterr().out.splitlines())
    assert f"(default: {weight})" in output.partition("--relative-entropy-weight ")[2].partition(" --")[0]
    assert "(default: paper)" in output
