"""How steadily methods learn, worked by hand."""

from csac.record.tables import COLUMNS, structured
from csac.record.rendering import markdown
from csac.studies.arms import Arm
from csac.studies.stability import stability_table


def arm(label, *seeds):
    """An arm with evaluations of one episode at 10, 20, ...: `seeds` [seed][point] are the returns."""
    rows = [
        [str(seed), str(10 * (t + 1)), "0", str(value), "5", ""]
        for seed, line in enumerate(seeds)
        for t, value in enumerate(line)
    ]
    return Arm(label, "Hopper-v4", evaluations=[structured(COLUMNS["evaluations"], rows)])


def test_two_seeds_of_which_one_falls():
    # Drawdowns 10 - 4 and 0. Changes 10, -6, 4, whose quartiles are -1 and 7, and none. Areas (5 + 7 + 6) / 3 and 2.
    # The halves of the distances 2, 8, 2 and 6 of the seeds are their interquartile ranges: 2.25 on average.
    _, _, row = markdown(stability_table([arm("A", [0, 10, 4, 8], [2, 2, 2, 2])], "")).splitlines()
    assert row == "| A | 2.00 (seed 1) | 3.00 ± 4.24 | 2.25 | 4.00 ± 5.66 | 4.00 ± 2.83 |"


def test_one_seed_has_no_dispersion_across_seeds_and_one_evaluation_next_to_nothing():
    table = stability_table([arm("A", [0, 10, 4, 8]), arm("B", [3])], "on a task")
    title, _, _, _, one, short = markdown(table).splitlines()
    assert title == "**on a task**"
    assert one == "| A | 7.33 (seed 0) | 6.00 |  | 8.00 | 6.00 |"
    assert short == "| B | 3.00 (seed 0) | 0.00 |  |  |  |"
