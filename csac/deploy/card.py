"""Write an artefact's model card: Markdown with the metadata header of the Hugging Face Hub."""

from __future__ import annotations

import json
from typing import Any

from csac.deploy.templates import render
from csac.record.rendering import SMALL, number

CARD = "README.md"
CURVE = "curve.png"


def model_card(fields: dict[str, Any], has_curve: bool) -> str:
    """Return the card for an artefact with these contract.json fields: what it does, how well, how it was trained."""
    return render(
        "card.md.jinja",
        **fields,
        has_curve=has_curve,
        returns=fields["verification"].get("returns") or fields["provenance"]["evaluation"],
        quoted=json.dumps,  # a JSON string is valid YAML
        with_deviation=_with_deviation,
        with_interval=_with_interval,
        code=_code,
    )


def _with_deviation(returns: dict[str, Any]) -> str:
    """Return `mean +/- standard deviation`, without commas, as cards on the Hub do."""
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
    """Return a value as inline code for a table cell."""
    text = value if isinstance(value, str) else json.dumps(value)
    return "`" + text.replace("|", "\\|").replace("`", "'") + "`"
