"""Grids of methods and tasks: what is over, and how long it took."""

import pytest
from made import MadeRecords

from csac.record.rendering import Table, markdown
from csac.studies.arms import Arm, Time, gather
from csac.studies.named import NAMED
from csac.studies.parts import Items, Paragraph
from csac.studies.standing import cells_so_far, wall_times


def lines_of(parts):
    """The rows of the tables, without headings, the sentences and the items."""
    found = {"rows": [], "sentences": [], "items": []}
    for part in parts:
        if isinstance(part, Table):
            found["rows"] += markdown(part).splitlines()[2:]
        elif isinstance(part, Paragraph):
            found["sentences"].append(part.text)
        elif isinstance(part, Items):
            found["items"] += part.texts
    return found


def arms(value=lambda cell, step: 1.0, failing=lambda cell: ""):
    study = NAMED["mujoco"][0].narrowed(["Walker2d-v4", "Ant-v4"], ["sac", "td3"], seeds=3)
    return gather(study, MadeRecords(value, failing))


def test_the_grid_counts_the_cells_and_names_below_it_what_failed():
    given = arms(
        lambda cell, _: None if cell.task == "Ant-v4" and (cell.algorithm == "td3" or cell.seed) else 1.0,
        lambda cell: "critic is not finite" if (cell.algorithm, cell.seed) == ("td3", 2) else "",
    )
    found = lines_of(cells_so_far(given))
    assert found["sentences"] == ["6 of 12 cells are complete, 1 failed, 5 are not over."]
    assert found["rows"] == ["| SAC | 3 of 3 | 1 of 3 |", "| TD3 | 2 of 3, 1 failed | – |"]
    assert found["items"] == ["TD3 on Walker2d-v4, seed 2 failed: critic is not finite"]


def test_a_complete_study_needs_no_grid():
    assert lines_of(cells_so_far(arms())) == {
        "rows": [],
        "sentences": ["12 of 12 cells are complete."],
        "items": [],
    }


def timed(label, task, *seconds, interrupted=None):
    times = [Time(one, 100, (seed,), interrupted) for seed, one in enumerate(seconds)]
    return Arm(label, task, times=times)


def test_a_run_that_took_twice_as_long_as_the_others_stands_out():
    found = lines_of(wall_times([timed("SAC", "Ant-v4", 60, 62, 180), timed("SAC", "Hopper-v4", 50, 50, 99)]))
    assert found["rows"] == ["| SAC | 1 min 2 s (3 runs) | 50 s (3 runs) |"]
    # 180 s are 2.95 times the median of 60 and 62; 99 s are less than twice 50.
    assert found["items"] == [
        "SAC, Ant-v4, seed 2: 3 min, for each step 3.0 times the median of the method's other runs there"
    ]


def test_a_run_alone_on_its_task_is_held_against_the_method_s_other_tasks():
    found = lines_of(
        wall_times([timed("SAC", "Ant-v4", 300), timed("SAC", "Hopper-v4", 60), timed("PPO", "Ant-v4", 9)])
    )
    assert found["rows"] == ["| SAC | 5 min | 1 min |", "| PPO | 9 s |  |"]
    assert [item.partition(":")[0] for item in found["items"]] == ["SAC, Ant-v4, seed 0"]


def test_interrupted_runs_are_in_no_median():
    mixed = timed("SAC", "Ant-v4", 60, interrupted=False)
    mixed.times.append(Time(100, 100, (1,), interrupted=True))
    found = lines_of(wall_times([mixed, timed("SAC", "Hopper-v4", 70, interrupted=True)]))
    assert found["rows"] == ["| SAC | 1 min | 1 min 10 s (interrupted) |"]


def test_no_time_is_known():
    assert list(wall_times([Arm("SAC", "Ant-v4")])) == []


@pytest.mark.parametrize("seeds", [1, 5])
def test_several_seeds_of_one_run_share_its_time(seeds):
    together = Arm("SAC", "Ant-v4", times=[Time(60.0 * seeds, 100, tuple(range(seeds)))])
    found = lines_of(wall_times([together, timed("SAC", "Hopper-v4", 60)]))
    assert found["items"] == []  # five seeds in five minutes are as fast as one in one
