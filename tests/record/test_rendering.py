import pytest

from csac.record.rendering import EMPTY, Cell, Row, Table, markdown, number, short


@pytest.mark.parametrize(("steps", "text"), [(999, "999"), (12_500, "12.5k"), (663_250, "663.2k"), (1_000_000, "1M")])
def test_steps_in_little_room(steps, text):
    assert short(steps) == text


@pytest.mark.parametrize(
    ("value", "largest", "text"),
    [
        (1.234, None, "1.23"),
        (-1234.56, None, "-1,234.6"),
        (1.234, 5000.0, "1.2"),
        (0.0042, None, "0.0042"),
        (-0.00012345, 0.05, "-0.000123"),
        (0.0042, 5.0, "0.00"),
        (0.0, None, "0.00"),
    ],
)
def test_a_column_has_one_number_of_decimals(value, largest, text):
    assert number(value, largest) == text


TABLE = Table(
    ("run", "return"),
    (
        Row((Cell("a | b", None), Cell("1,000.5", 1000.5))),
        Row((Cell("<c>", None), EMPTY), "failed"),
        Row((Cell("mean", None), Cell("never", float("inf"))), "summary"),
    ),
    title="T & U",
    note="2 seeds: no interval",
)


def test_markdown_puts_numbers_to_the_right_and_keeps_bars_out():
    assert markdown(TABLE).splitlines() == [
        "**T & U**",
        "",
        "| run | return |",
        "| --- | ---: |",
        "| a \\| b | 1,000.5 |",
        "| <c> |  |",
        "| mean | never |",
        "",
        "2 seeds: no interval",
    ]
