import io

import pytest
from rich.console import Console
from shown import Clock


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def plain():
    return Console(file=io.StringIO(), width=100, markup=False, highlight=False)


@pytest.fixture
def terminal():
    return Console(
        file=io.StringIO(), width=80, force_terminal=True, color_system=None, _environ={"TERM": "xterm-256color"}
    )
