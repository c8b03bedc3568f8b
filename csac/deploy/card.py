"""A model card beside an artefact: Markdown with a header in the form of the Hugging Face Hub."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from csac.deploy.templates import template
from csac.record.rendering import SMALL, number

if TYPE_CHECKING:
    from csac.deploy.artefact_contract import ArtefactContract


def model_card(contract: ArtefactContract, curve: str | None) -> str:
    """Return the card of an artefact: what it does, how well, how it was made, how to run it.

    `curve` is the name of a picture beside it.
    """
    fields = contract.fields()
    returns = contract.verification.get("returns") or contract.provenance["evaluation"]
    return template("card.md.jinja").render(
        **fields,
        contract=contract,
        curve=curve,
        returns=returns,
        has_fresh_returns="returns" in contract.verification,
        quoted=json.dumps,  # what JSON writes, YAML reads
        with_deviation=_with_deviation,
        with_interval=_with_interval,
        code=_code,
    )


def _with_deviation(returns: dict[str, Any]) -> str:
    """Return a mean and the standard deviation, as cards on the Hub have them."""
    mean, deviation = returns["mean_return"], returns["standard_deviation"] or 0.0
    return f"{mean:{_form(mean)}} +/- {deviation:{_form(mean)}}"


def _with_interval(returns: dict[str, Any]) -> str:
    """Return a mean, and its interval where there is one."""
    mean = returns["mean_return"]
    if returns["interval_95"] is None:
        return f"{number(mean)} (too few for an interval)"
    low, high = (number(end, mean) for end in returns["interval_95"])
    return f"{number(mean)} (95 % t-interval {low} to {high})"


def _form(mean: float) -> str:
    """Return the format of a mean and its deviation, without commas: other programs read it."""
    return ".3g" if 0 < abs(mean) < SMALL else ".2f"


def _code(value: Any) -> str:
    """Return a value as code in a cell of a table."""
    text = value if isinstance(value, str) else json.dumps(value)
    return "`" + text.replace("|", "\\|").replace("`", "'") + "`"
