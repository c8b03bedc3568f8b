"""What artefacts are made of: the C header, the model card, the loader that leaves as it is, what times a header."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Template

LOADER = Path(__file__).parent / "policy.py"
LATENCY = Path(__file__).parent / "latency.c"


def template(name: str) -> Template:
    """Return a template of this folder."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    return environment.get_template(name)
