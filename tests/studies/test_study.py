import re
from collections import Counter
from pathlib import Path

import pytest
from studying import TINY, write

from csac.studies.named import NAMED, WHOLE, find
from csac.studies.study import Method, Study, cells_of, read_study
from csac.types import InputError

STUDY = Study(
    "here",
    "Here",
    tasks=("Hopper-v4", "Walker2d-v4"),
    methods=(Method("SAC", "sac"), Method("CSAC (paper)", "csac", "paper"), Method("PPO", "ppo")),
    seeds=3,
    steps_on={"Hopper-v4": 2_000_000},
    conditions=((), ("friction=2@300000",)),
)


def test_a_cell_for_each_task_condition_method_and_seed():
    cells = cells_of([STUDY])
    assert len(cells) == 2 * 2 * 3 * 3
    assert {one.seed for one in cells[:12]} == {0}  # seed by seed
    assert {(one.task, one.steps) for one in cells} == {("Hopper-v4", 2_000_000), ("Walker2d-v4", 1_000_000)}
    csac = next(one for one in cells if one.algorithm == "csac")
    assert csac.hyperparameters["reference_period"] == 1


def test_a_shortened_study_says_what_it_shortens():
    steps = {one.task: one.steps for one in cells_of([STUDY.shortened(0.05)])}
    assert steps == {"Hopper-v4": 100_000, "Walker2d-v4": 50_000}
    cells = {(one.task, one.algorithm, one.perturbations): one for one in cells_of([STUDY.shortened(0.05)])}
    hopper, walker = (cells[task, "sac", ()] for task in ("Hopper-v4", "Walker2d-v4"))
    # Twenty evaluations at least, and a tenth of the steps as warm-up at most.
    assert (hopper.evaluation_interval, walker.evaluation_interval) == (5_000, 2_500)
    assert (hopper.hyperparameters["warmup_steps"], walker.hyperparameters["warmup_steps"]) == (10_000, 5_000)
    assert ("Walker2d-v4", "sac", ("friction=2@15000",)) in cells
    assert "warmup_steps" not in cells["Hopper-v4", "ppo", ()].hyperparameters


def test_the_whole_scale_changes_nothing():
    assert cells_of([STUDY.shortened(1.0)]) == cells_of([STUDY])


def test_narrowed_studies_share_their_cells_with_the_whole_one():
    whole = {one.key for one in cells_of([STUDY])}
    part = cells_of([STUDY.narrowed(["Walker2d-v4"], ["sac", "CSAC (paper)"], 2)])
    assert len(part) == 2 * 2 * 2
    assert {one.key for one in part} < whole
    more = cells_of([STUDY.narrowed(seeds=5)])
    assert whole < {one.key for one in more}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tasks": ["Hoper-v4"]}, "here has no task 'Hoper-v4'; did you mean Hopper-v4?"),
        ({"algorithms": ["td3"]}, "here has no algorithm or method 'td3': there is sac, SAC, csac, CSAC (paper), ppo"),
        ({"seeds": 0}, "seeds must be at least 1, not 0"),
        ({"seeds": 5_000_000_000}, "the last seed would be 4,999,999,999: seeds are below 4,294,967,296"),
        (
            {"seeds": 8_334},
            "here would have 100,008 cells, and 100,000 is the most: give fewer seeds, tasks, methods or conditions",
        ),
    ],
)
def test_narrowing_to_what_there_is_not(arguments, message):
    with pytest.raises(InputError) as raised:
        STUDY.narrowed(**arguments)
    assert message in str(raised.value)


@pytest.mark.parametrize("scale", [0, -1, 1.5])
def test_a_scale_is_a_share(scale):
    with pytest.raises(InputError, match="a share of the steps"):
        STUDY.shortened(scale)


# Studies by name.


def test_studies_share_what_they_have_in_common():
    keys = {name: {one.key for one in cells_of(studies)} for name, studies in NAMED.items()}
    assert keys["efficiency"] == keys["mujoco"]
    assert len(keys["ablation"] & keys["mujoco"]) == 2 * 5  # tau 0.5, for both of CSAC's variants
    assert len(keys["reference"] & keys["mujoco"]) == 3 * 3 * 5  # SAC 0.2, the paper's CSAC and the default
    assert len(keys["mujoco"]) == 4 * 6 * 5
    assert len(keys["robustness"]) == 3 * 3 * 5


def test_the_page_on_clusters_says_what_all_of_it_costs():
    steps, cells = Counter[str](), cells_of(WHOLE)
    for one in cells:
        steps[one.algorithm.upper()] += one.steps // 10**6
    page = (Path(__file__).parents[2] / "docs" / "cluster.md").read_text()
    rows = re.findall(r"^\| (\w+) \| (\d+) \| ([\d.]+) \| (\d+) \|$", page, re.MULTILINE)
    assert {name: int(million) for name, million, *_ in rows} == steps
    hours = {name: int(million) * 10 * float(minutes) / 60 for name, million, minutes, _ in rows}
    assert {name: int(told) for name, *_, told in rows} == {name: round(own) for name, own in hours.items()}
    assert f"| together, {len(cells)} cells | {sum(steps.values())} | | {sum(hours.values()):,.0f} |" in page
    for cores in (2, 16):
        some, fewer = sum(hours.values()) / cores, (sum(hours.values()) - hours["SD3"]) / cores
        assert f"{cores} cores | {some:.0f} hours | {fewer:.0f} hours |" in page


def test_smoke_has_something_of_every_study():
    assert [study.name for study in NAMED["smoke"]] == [name for name in NAMED if name != "smoke"]
    assert max(one.steps for one in cells_of(NAMED["smoke"])) <= 2_000


def test_the_paper_s_preset_depends_on_the_task():
    (study,) = NAMED["quadx"]
    assert study.methods[0].hyperparameters_on(study.tasks[0])["relative_entropy_weight"] == 0.1


def test_a_name_that_there_is_not():
    with pytest.raises(InputError, match="no study is called 'mojoco'; did you mean mujoco"):
        find("mojoco")


# Studies of one's own.


def test_a_toml_file_is_a_study(tmp_path):
    study = read_study(write(tmp_path / "mine.toml"))
    assert (study.name, study.title, study.seeds) == ("mine", "Tiny", 2)
    first, second = cells_of([study])
    assert (first.seed, second.seed, first.steps) == (0, 1, 300)
    assert first.hyperparameters["actor_hidden_sizes"] == (8, 8)


def test_a_file_that_begins_with_a_byte_order_mark_is_read(tmp_path):
    path = write(tmp_path / "mine.toml", f"\ufeff{TINY}")
    assert read_study(path).seeds == 2


def test_a_sweep_is_a_method_for_each_combination(tmp_path):
    text = (
        TINY.replace('"sac"', '"csac"') + "[methods.sweep]\nrelative_entropy_weight = [0.5, 5]\nbatch_size = [4, 8]\n"
    )
    study = read_study(write(tmp_path / "mine.toml", text))
    assert [method.label for method in study.methods][:2] == [
        "SAC, relative_entropy_weight 0.5, batch_size 4",
        "SAC, relative_entropy_weight 0.5, batch_size 8",
    ]
    assert len({one.key for one in cells_of([study])}) == 4 * 2


def test_what_methods_have_in_common_gives_way_to_presets_and_to_their_own(tmp_path):
    text = """
        tasks = ["Hopper-v4"]
        common.csac = { relative_entropy_weight = 7, entropy_weight = 3, policy_delay = 5, critic_learning_rate = 1 }
        [[methods]]
        algorithm = "csac"
        preset = "paper"
        hyperparameters = { entropy_weight = 2 }
        [[methods]]
        algorithm = "sac"
    """
    csac, sac = read_study(write(tmp_path / "mine.toml", text)).methods
    told = csac.hyperparameters_on("Hopper-v4")
    assert (told["entropy_weight"], told["relative_entropy_weight"], told["policy_delay"]) == (2.0, 0.5, 5)
    assert sac.hyperparameters_on("Hopper-v4")["critic_learning_rate"] == 3e-4


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("tasks =", "taks ="), "a study has no 'taks'; did you mean tasks?"),
        (('algorithm = "sac"', 'algoritm = "sac"'), "a method has no 'algoritm'; did you mean algorithm?"),
        (('algorithm = "sac"', ""), "a method needs an algorithm"),
        (('algorithm = "sac"', 'algorithm = "scc"'), "no algorithm is called 'scc'; did you mean sac?"),
        (("batch_size = 8", "bach_size = 8"), "sac has no hyperparameter 'bach_size'; did you mean batch_size?"),
        (("seeds = 2", "common.sac.bach_size = 8"), "sac has no hyperparameter 'bach_size'; did you mean batch_size?"),
        (("seeds = 2", "common.sac = 8"), "common.sac is a table of hyperparameters, not 8"),
        (("seeds = 2", 'seeds = "two"'), "seeds is a whole number, not 'two'"),
        (("seeds = 2", "seeds = 0"), "seeds must be at least 1, not 0"),
        (("seeds = 2", "first_seed = -1"), "first_seed must be 0 or more, not -1"),
        (("seeds = 2", "rollouts = -4"), "rollouts must be 0 or more, not -4"),
        (("seeds = 2", "seeds = "), "is not TOML"),
        (('tasks = ["Hopper-v4"]', 'tasks = ["Hoper-v4"]'), "no task is called Hoper-v4: did you mean Hopper-v4"),
        (("seeds = 2", 'steps_on = {"Hopper-v4" = -5}'), "steps_on.Hopper-v4 must be at least 1, not -5"),
        (('algorithm = "sac"', 'algorithm = "sac"\npublished = "SAC2"'), "the paper has no 'SAC2'; did you mean SAC?"),
        (('tasks = ["Hopper-v4"]', "tasks = []"), "tasks missing"),
        (('tasks = ["Hopper-v4"]', 'tasks = "Hopper-v4"'), "tasks is a list of texts, not 'Hopper-v4'"),
        (("seeds = 2", 'conditions = [["fricton=2@10"]]'), "'fricton': there are friction"),
        (("seeds = 2", 'conditions = [["friction=2@300"]]'), "would change nothing: the run ends at step 300"),
        (("seeds = 2", 'analyses = ["curve"]'), "analyses: there is no 'curve'; did you mean curves?"),
        (("seeds = 2", 'steps_on = {"Hopper-v5" = 10}'), "the study has no task 'Hopper-v5'; did you mean Hopper-v4?"),
        (("replay_size = 150", "[[methods]]\nlabel = 'SAC'\nalgorithm = 'sac'"), "two methods are called 'SAC'"),
        (('tasks = ["Hopper-v4"]', 'tasks = ["Hopper-v4", "Hopper-v4"]'), "tasks has 'Hopper-v4' twice"),
        (("seeds = 2", "conditions = ['friction=2@10']"), "conditions is a list of lists, such as"),
        (("seeds = 2", "conditions = [[], []]"), "conditions has [] twice"),
        (
            ("seeds = 2", "conditions = [['friction=2@10'], ['friction=2.0@1e1']]"),
            'conditions has ["friction=2@10"] twice: its runs would count twice',
        ),
        (("seeds = 2", "steps_on = {'Hopper-v4' = 5_000_000_000}"), "steps_on.Hopper-v4 must be at most"),
        (("seeds = 2", "seeds = 2\nfirst_seed = 4294967295"), "the last seed would be 4,294,967,296"),
        (
            ("replay_size = 150", "[methods.sweep]\ndiscount = [0, 0.0]"),
            "the methods 'SAC, discount 0' and 'SAC, discount 0.0' are the same: leave one of them out",
        ),
        (('label = "SAC"', 'label = " "'), "' ' is no label: it is a line of text"),
        (('label = "SAC"', 'label = "SAC\\n2"'), "'SAC\\n2' is no label: it is a line of text"),
        (("seeds = 2", "seeds = 100_001"), "mine would have 100,001 cells, and 100,000 is the most: give fewer seeds"),
        (
            ("replay_size = 150", f"[methods.sweep]\nbatch_size = {[*range(400)]}\nreplay_size = {[*range(400)]}"),
            "a sweep would be 160,000 methods, and a study has at most 100,000 cells",
        ),
        (("evaluation_interval = 100", f"evaluation_interval = {10**23}"), "evaluation_interval must be at most"),
        (
            ("evaluation_episodes = 2", "evaluation_episodes = 1_000_001"),
            "evaluation_episodes must be at most 1,000,000, not 1,000,001",
        ),
        (("seeds = 2", "rollouts = 1_000_001"), "rollouts must be at most 1,000,000, not 1,000,001"),
        (("seeds = 2", f"rollouts = {'9' * 5_000}"), "is not TOML: "),
        (("seeds = 2", "environment_arguments = {d = 2020-01-01}"), "environment_arguments holds numbers, texts"),
    ],
)
def test_mistakes_in_a_file_are_told_in_one_line(tmp_path, change, message):
    path = write(tmp_path / "mine.toml", TINY.replace(*change))
    with pytest.raises(InputError) as raised:
        read_study(path)
    assert str(raised.value).startswith(str(path))
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_file_that_there_is_not(tmp_path):
    with pytest.raises(InputError, match=r"cannot read .*: No such file"):
        find(str(tmp_path / "mine.toml"))
