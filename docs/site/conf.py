"""How `make docs` makes the site: the repository itself is its source, so links work as they do in a clone."""

from __future__ import annotations

import importlib.metadata
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT = Path(__file__).parents[2]

project, author, release = "csac", "The csac authors", importlib.metadata.version("csac")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
root_doc = "README"
include_patterns = ["*.md", "docs/**.md", "docs/reference/*.rst", "results/**.md", "benchmarks/*.md"]
exclude_patterns = [".*", "csac", "examples", "runs", "site", "tests"]
suppress_warnings = ["ref.python"]  # InputError and Policy have two places: the package, and their module

html_theme = "furo"  # system fonts, light and dark; nothing is fetched from elsewhere
html_title = f"csac {release}"
html_extra_path = ["index.html"]
html_static_path, html_css_files = ["static"], ["site.css"]
html_show_copyright = html_show_sphinx = False

myst_heading_anchors = 3
smartquotes = False
highlight_language = "none"  # of blocks that name none: shell lines, and what commands print
default_role = "code"  # of single backticks in docstrings
autodoc_member_order = "bysource"
viewcode_follow_imported_members = False
autodoc_default_options = {"members": True}

# The side of each page. What stands in docs/ and in no list comes last, so that a new page is seen at once.
NAVIGATION = {
    "Tutorials": [
        "docs/README",
        "docs/tutorials/first-controller",
        "docs/tutorials/your-own-environment",
        "docs/tutorials/from-training-to-a-robot",
    ],
    "How to": [
        "docs/choosing-an-algorithm",
        "docs/callbacks-and-logging",
        "docs/saving-and-resuming",
        "docs/vector-environments",
        "docs/learning-options",
        "docs/perturbations",
        "docs/deploy",
        "docs/tuning",
        "docs/studies",
        "docs/cluster",
        "docs/gpu",
        "docs/from-stable-baselines3",
        "docs/troubleshooting",
        "docs/adding-an-algorithm",
    ],
    "Reference": [
        "docs/python",
        *[f"docs/algorithms/{name}" for name in ("csac", "sac", "td3", "sd3", "ppo", "critics")],
        "docs/tasks",
        "docs/statistics",
        "docs/glossary",
        "docs/reference/csac",
        "CHANGELOG",
    ],
    "Explanation": ["docs/results", "docs/relative-entropy", "docs/performance", "docs/design", "CONTRIBUTING"],
    "Measured": ["results/README", "benchmarks/README", "benchmarks/limit", "results/*/*"],
}


def add_navigation(_: Sphinx, page: str, text: list[str]) -> None:
    """Give the front page, which is the README, the lists of all others."""
    if page != root_doc:
        return
    listed = {name for names in NAVIGATION.values() for name in names}
    others = sorted({f"docs/{path.stem}" for path in (ROOT / "docs").glob("*.md")} - listed)
    for caption, names in (NAVIGATION | {"More": others}).items():
        if names:
            text[0] += "\n".join(
                ["", "```{toctree}", ":hidden:", ":glob:", f":caption: {caption}", "", *names, "```", ""]
            )


def read_as_text(_: Sphinx, kind: str, name: str, member: Any, options: Any, lines: list[str]) -> None:
    """Take a docstring for what it is: plain text with code in backticks, and indented code in that of a module."""
    pieces = re.split("(`[^`]*`)", "\n".join(lines))
    text = "".join(piece if piece.startswith("`") else re.sub(r"([*|]|_\b)", r"\\\1", piece) for piece in pieces)
    if kind == "module":
        text = text.replace("\n\n    ", "\n\n::\n\n    ")
    lines[:] = text.split("\n")


def skip_counted_fields(_: Sphinx, kind: str, name: str, member: Any, skip: bool, options: Any) -> bool | None:
    """Leave out the fields of a NamedTuple that have no docstring: its signature has them already."""
    return True if (getattr(member, "__doc__", None) or "").startswith("Alias for field number") else None


def setup(app: Sphinx) -> None:
    """Connect the functions above."""
    app.connect("source-read", add_navigation)
    app.connect("autodoc-process-docstring", read_as_text, priority=400)  # before Napoleon reads its sections
    app.connect("autodoc-skip-member", skip_counted_fields)
