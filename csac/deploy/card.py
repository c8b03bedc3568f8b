"""A model card beside an artefact: Markdown with a header in the form of the Hugging Face Hub."""

from __future__ import annotations

import json
from typing import Any

from csac.deploy.templates import render
from csac.record.rendering import SMALL, number

CARD = "README.md"
CURVE = "curve.png"


def model_card(fields: dict[str, Any], has_curve: bool) -> str:
    """Return the card of an artefact with these fields in contract.json: what it does, how well, how it was made."""
    return render(
        "card.md.jinja",
        **fields,
        has_curve=has_curve,
        returns=fields["verification"].get("returns") or fields["provenance"]["evaluation"],
        quoted=json.dumps,  # what JSON writes, YAML reads
        with_deviation=_with_deviation,
        with_interval=_with_interval,
        code=_code,
    )


def _with_deviation(returns: dict[str, Any]) -> str:
    """Return a mean and the standard deviation, as cards on the Hub have them: without commas."""
    mean, deviation = returns["mean_return"], returns["standard_deviation"] or 0.0
    form = ".3g" if 0 < abs(mean) < SMALL else ".2f"
    return f"{mean:{form}} +/- {deviation:{form}}"


def _with_interval(returns: dict[str, Any]) -> str:
    mean = returns["mean_return"]
    if returns["interval_95"] is None:
        return f"{number(mean)} (too few for an interval)"
    low, high = (number(end, mean) for end in returns["interval_95"])
    return f"{number(mean)} (95 % t-interval {low} to {high})"


def _code(value: Any) -> str:
    """Return a value as code in a cell of a table."""
    text = value if isinstance(value, str) else json.dumps(value)
    return "`" + text.replace("|", "\\|").replace("`", "'") + "`"
