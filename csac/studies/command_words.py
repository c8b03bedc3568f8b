"""Settings as the words of a command that gives them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping


def changed(given: Mapping[str, Any], default: Mapping[str, Any]) -> list[str]:
    """Return the options for what is not as it is by default."""
    return options({name: value for name, value in given.items() if value != default[name]})


def options(given: Mapping[str, Any]) -> list[str]:
    """Return the options for all of these settings."""
    return [word for name, value in given.items() for word in _option(name, value)]


def _option(name: str, value: Any) -> list[str]:
    """Return one option. None cannot be typed: it is what leaving the option out means."""
    flag = name.replace("_", "-")
    if value is None:
        return []
    if isinstance(value, bool):
        return [f"--{flag}" if value else f"--no-{flag}"]
    return [f"--{flag}", *map(str, value if isinstance(value, list | tuple) else (value,))]
