"""A report as one page for a browser: nothing is fetched, it works without a network and prints on paper."""

from __future__ import annotations

import base64
import json
from typing import TYPE_CHECKING, Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from csac.record import rendering
from csac.studies.interactive import CONTRAST, note_of, plots
from csac.studies.parts import Commands, Figure, Heading, Items, Paragraph

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from csac.studies.parts import Part


def page(title: str, parts: Sequence[Part], still: Mapping[str, bytes]) -> str:
    """Return the page. `still` are the pictures of its figures as PNG, by name: for paper, and where no script runs."""
    from plotly.offline import get_plotlyjs  # slow to import

    environment = Environment(
        loader=PackageLoader("csac.studies"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html.jinja").render(
        title=title,
        parts=[_fields(part, still) for part in parts],
        contents=[(index, part) for index, part in enumerate(parts) if isinstance(part, Heading)],
        has_figures=bool(still),
        plotly=Markup(get_plotlyjs()) if still else "",
        contrast=CONTRAST,
    )


def _fields(part: Part, still: Mapping[str, bytes]) -> dict[str, Any]:
    """Return what the template shows of a part."""
    match part:
        case Heading(text, level):
            return {"kind": "heading", "text": text, "level": level}
        case Paragraph(text, strong):
            return {"kind": "paragraph", "text": text, "strong": strong}
        case Items(texts):
            return {"kind": "items", "texts": texts}
        case Commands(lines):
            return {"kind": "commands", "lines": lines}
        case Figure(name, title, drawing):
            picture = base64.b64encode(still[name]).decode()
            shown = [(plot.title, _json({"data": plot.data, "layout": plot.layout})) for plot in plots(drawing)]
            return {"kind": "figure", "title": title, "note": note_of(drawing), "plots": shown, "picture": picture}
        case _:
            return {"kind": "table", "table": Markup(rendering.html(part))}


def _json(value: Any) -> Markup:
    """Return JSON that nothing in it can end: it stands inside a script element."""
    return Markup(json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"))
