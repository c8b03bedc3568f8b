"""What a report consists of: headings, paragraphs, lists, tables, figures and commands, in one order.

`write` renders the same parts twice: in Markdown with pictures beside it, and as one page for a browser.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from csac.record import rendering
from csac.record.files import write_atomically
from csac.record.rendering import Table
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from csac.studies.figures import Drawing


class Heading(NamedTuple):
    """A title: of the report or one of its studies (1), of a section (2)."""

    text: str
    level: int = 2


class Paragraph(NamedTuple):
    """Some sentences; `strong` stands before them."""

    text: str
    strong: str = ""


class Items(NamedTuple):
    """A list."""

    texts: tuple[str, ...]


class Commands(NamedTuple):
    """Lines to type."""

    lines: tuple[str, ...]


class Figure(NamedTuple):
    """A drawing and its title; `name` is what its files are called, without their suffix."""

    name: str
    title: str
    drawing: Drawing


Part = Heading | Paragraph | Items | Commands | Figure | Table


def write(path: Path, title: str, parts: Sequence[Part]) -> None:
    """Write the page `path`, and beside it the same in Markdown and its pictures as PNG and SVG.

    Raises:
        InputError: it cannot be written.
    """
    from csac.studies.page import page

    pictures = [part for part in parts if isinstance(part, Figure)]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for figure in pictures:
            figure.drawing.save(path.parent / f"{figure.name}.png", figure.title)
        write_atomically(path.with_suffix(".md"), markdown(parts).encode())
        still = {figure.name: (path.parent / f"{figure.name}.png").read_bytes() for figure in pictures}
        write_atomically(path, page(title, parts, still).encode())
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}; choose another place") from error


def markdown(parts: Sequence[Part]) -> str:
    """Return the report in Markdown."""
    return "\n\n".join(map(_markdown, parts)) + "\n"


def _markdown(part: Part) -> str:
    match part:
        case Heading(text, level):
            return f"{'#' * level} {text}"
        case Paragraph(text, strong):
            return f"**{strong}** {text}".strip() if strong else text
        case Items(texts):
            return "\n".join(f"- {text}" for text in texts)
        case Commands(lines):
            return "\n".join(["```sh", *lines, "```"])
        case Figure(name, title):
            return f"![{title}]({name}.png) ([SVG]({name}.svg))"
        case Table():
            return rendering.markdown(part)
