import collections
import itertools
import json
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import plotly.graph_objects
import pytest
from made import MadeRecords
from matplotlib.figure import Figure

from csac.studies import paper
from csac.studies.arms import Arm, gather
from csac.studies.claims import Comparison, comparisons, decide, interactions, lower_boundary
from csac.studies.command_words import changed
from csac.studies.named import NAMED
from csac.studies.report import train_command, write_report
from csac.studies.study import ANALYSES, read_study

HEIGHTS = {"csac": 6_000, "sac": 5_000, "td3": 4_000, "sd3": 3_000, "ppo": 1_000}


def made(cell, step):
    """A straight line up to the algorithm's height, a little higher for each seed."""
    return (HEIGHTS[cell.algorithm] + 10 * cell.seed) * step / cell.steps


def mujoco(**narrow):
    (study,) = NAMED["mujoco"]
    return study.narrowed(["HalfCheetah-v4"], **narrow)


def markdown_of(studies, source, directory):
    return write_report(studies, source, directory, ["csac study run it"]).with_suffix(".md").read_text()


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A function that gives the page and the Markdown of a study's first task, written once."""
    written = {}

    def give(name):
        if name not in written:
            (study,) = NAMED[name]
            directory = tmp_path_factory.mktemp(name)
            written[name] = page_of([study.narrowed(tasks=study.tasks[:1])], directory), directory
        return written[name]

    return give


def page_of(studies, directory):
    path = write_report(studies, MadeRecords(made), directory, ["csac study run it"])
    return path.read_text(), path.with_suffix(".md").read_text()


def compare(ours, others, is_whole=True):
    ours, others = (np.array(one, float) for one in (ours, others))
    return decide(Comparison("ours is better", ours, others, is_whole=is_whole))


def claims_of(study, value=None, **record):
    arms = gather(study, MadeRecords(value or made, **record))
    return {f"{one.variant}: {one.claim}": decide(one).verdict for one in comparisons(study, arms)}


# Verdicts.


@pytest.mark.parametrize(
    ("ours", "others", "verdict"),
    [
        ([6, 7, 8, 9, 10], [1, 2, 3, 4, 5], "reproduced"),
        ([1, 2, 3, 4, 5], [6, 7, 8, 9, 10], "not reproduced"),
        ([1, 2, 3, 4, 5], [1, 2, 3, 4, 5], "not yet decidable"),
        ([6, 7, 8, 9], [1, 2, 3, 4], "not yet decidable"),
    ],
)
def test_verdicts(ours, others, verdict):
    assert compare(ours, others).verdict == verdict


@pytest.mark.slow
def test_how_often_methods_that_do_not_differ_are_told_apart():
    """Of two such methods with five seeds each, every order of their ten returns is as likely: docs/studies.md."""
    verdicts = collections.Counter(
        compare(ours, [rank for rank in range(10) if rank not in ours]).verdict
        for ours in itertools.combinations(range(10), 5)
    )
    assert verdicts == {"reproduced": 12, "not reproduced": 12, "not yet decidable": 228}


def test_a_verdict_says_why():
    assert compare([6, 7, 8, 9, 10], [1, 2, 3, 4, 5]).why == (
        "better in 100% of the pairs of seeds, 95 % interval 100% to 100%"
    )
    assert compare([2], [1, 1, 1, 1, 1]).why == "better in 100% of the pairs of seeds; 1 seed: no interval below 5"


def test_shortened_runs_decide_nothing():
    decision = compare([6, 7, 8, 9, 10], [1, 2, 3, 4, 5], is_whole=False)
    assert decision.verdict == "not yet decidable"
    assert decision.why.startswith("of the shortened runs it holds: ")


def test_a_verdict_says_which_seeds_failed():
    """Of seven seeds of each SAC has lost two and CSAC one: enough are left to decide."""
    study = mujoco(algorithms=["CSAC (paper)", "sac"], seeds=7)
    lost = {"sac": (1, 3), "csac": (0,)}
    source = MadeRecords(made, lambda cell: "not finite" * (cell.seed in lost[cell.algorithm]))
    decisions = [decide(one) for one in comparisons(study, gather(study, source))]
    assert {one.verdict for one in decisions} >= {"reproduced"}
    told = "; 1 seed of CSAC (paper) failed and is not counted; 2 seeds of SAC failed and are not counted"
    assert all(one.why.endswith(told) for one in decisions)
    assert not any("failed" in decide(one).why for one in comparisons(study, gather(study, MadeRecords(made))))


@pytest.mark.parametrize(
    ("lost", "algorithms", "lacking"),
    [
        ((), None, ""),
        (("ppo",), None, "PPO"),
        (("ppo", "sd3"), None, "PPO, SD3"),
        ((), ["csac", "sac"], "PPO"),
        ((), ["csac", "sac", "ppo"], ""),
    ],
)
def test_the_lower_boundary_hangs_on_every_method_of_the_paper(lost, algorithms, lacking):
    """Without the last seed of PPO, or without PPO, it is another quantity than the paper's."""
    study = NAMED["efficiency"][0].narrowed(["HalfCheetah-v4"], algorithms)

    def value(cell, step):
        return None if cell.algorithm in lost and cell.seed == 4 else made(cell, step)

    decisions = [decide(one) for one in comparisons(study, gather(study, MadeRecords(value)))]
    found = {
        one.verdict
        for one in decisions
        if one.claim.endswith("fewer interactions than SAC to reach the lower boundary")
    }
    assert found == {"not yet decidable" if lacking else "reproduced"}
    assert {one.why.partition("the boundary lacks runs of ")[2] for one in decisions} == {lacking}


def test_the_claims_of_the_tables():
    """Of each variant of CSAC: four methods on three tasks, and on Hopper, where SD3 has more, three; all hold."""
    claims = claims_of(NAMED["mujoco"][0])
    returns = {claim: verdict for claim, verdict in claims.items() if "a higher maximum average return" in claim}
    assert len(returns) == 2 * (3 * 4 + 3)
    assert set(returns.values()) == {"reproduced"}
    assert len(claims) == len(returns) + 2 * 2 * 4  # a curve that falls less than SAC's, and seeds nearer together
    assert len(claims_of(NAMED["ablation"][0])) == 2 * 4
    assert len(claims_of(NAMED["robustness"][0])) == 2 * 3 * 3


def test_a_weight_of_the_paper_s_stands_beside_other_methods(tmp_path):
    """Weights are told by the column, whatever the method was given; the others have the claims that they had."""
    alone = claims_of(of_ones_own(tmp_path, "steps = 1_000_000"))
    methods = """
[[methods]]
label = "weight, best"
algorithm = "csac"
published = "tau 0.5"
[[methods]]
label = "weight, most"
algorithm = "csac"
preset = "paper"
hyperparameters = { relative_entropy_weight = 5.0 }
published = "tau 50"
[[methods]]
label = "weight, learnt"
algorithm = "csac"
hyperparameters = { relative_entropy_weight = "auto", reference_policy = "periodic" }"""
    claims = claims_of(of_ones_own(tmp_path, "steps = 1_000_000", methods))
    assert alone.items() < claims.items()
    assert [claim for claim in claims if "tau" in claim] == ["weight: tau 0.5: a higher maximum average return than 50"]


def test_a_steadier_method_falls_less_and_its_seeds_are_nearer_together():
    def value(cell, step):
        height, fall = (100, 50 + cell.seed) if cell.algorithm == "sac" else (1, 5)
        return 6_000 + height * cell.seed - (fall if step == cell.steps else 0)

    study = mujoco(algorithms=["CSAC (paper)", "sac"])
    claims = {one.claim.partition(": ")[2]: one for one in comparisons(study, gather(study, MadeRecords(value)))}
    fall = claims["a smaller largest fall of a learning curve than SAC"]
    assert (fall.ours.tolist(), fall.others.tolist()) == ([-5] * 5, [-50, -51, -52, -53, -54])
    nearer = claims["maximum average returns of the seeds nearer to their mean than SAC's"]
    assert (nearer.ours.tolist(), nearer.others.tolist()) == ([-2, -1, 0, -1, -2], [-200, -100, 0, -100, -200])


def test_the_arm_succeeds_sooner():
    claims = claims_of(NAMED["panda"][0].narrowed(algorithms=["csac", "sac"]))
    claim = "PandaReach-v3: success in 95% of an evaluation's episodes sooner than SAC"
    assert claims[f"CSAC (paper): {claim}"] == "not yet decidable"  # every episode of the made records succeeds
    assert claims[f"CSAC (periodic): {claim}"] == "not yet decidable"


def test_how_rollouts_end_is_claimed_of_the_papers_task_alone():
    study = NAMED["quadx"][0].narrowed(algorithms=["csac", "sac"], seeds=2)
    assert any("rollouts with" in claim for claim in claims_of(study))
    elsewhere = replace(study, tasks=("Hopper-v4",), events=())
    assert not any("rollouts with" in claim for claim in claims_of(elsewhere))


def of_ones_own(tmp_path, text, methods=""):
    path = tmp_path / "mine.toml"
    path.write_text(
        f"""
tasks = ["HalfCheetah-v4"]
{text}
[[methods]]
algorithm = "csac"
preset = "paper"
[[methods]]
algorithm = "sac"
published = "SAC"
{methods}"""
    )
    return read_study(path)


def test_runs_that_are_shorter_than_the_paper_s_say_nothing_of_it(tmp_path):
    short = claims_of(of_ones_own(tmp_path, "steps = 100_000"))
    assert set(short.values()) == {"not yet decidable"}
    assert "reproduced" in claims_of(of_ones_own(tmp_path, "steps = 1_000_000")).values()


def test_a_file_may_be_called_as_a_named_study(tmp_path):
    """Of `reference` nothing is claimed, which hangs on the study and not on its name."""
    study = of_ones_own(tmp_path, "")
    (tmp_path / "mine.toml").rename(tmp_path / "reference.toml")
    assert claims_of(read_study(tmp_path / "reference.toml")) == claims_of(study) != {}
    for name in ("reference", "smoke"):
        (reference,) = (one for one in NAMED[name] if one.name == "reference")
        assert claims_of(reference.narrowed(["Hopper-v4"], seeds=1)) == {}


def test_only_the_paper_s_friction_is_claimed(tmp_path):
    analyses = 'analyses = ["robustness"]\nconditions = '
    claims = claims_of(of_ones_own(tmp_path, analyses + '[[], ["friction=1.5@300000"], ["friction=3@300000"]]'))
    assert len(claims) == 3
    assert all("friction=1.5" in claim for claim in claims)
    assert not claims_of(of_ones_own(tmp_path, analyses + '[[], ["friction=1.5@300000", "gravity=2@400000"]]'))


def test_robustness_is_claimed_of_the_paper_s_task_alone(tmp_path):
    """A second task is neither claimed nor mixed with the first."""
    analyses = 'analyses = ["robustness"]\nconditions = [[], ["friction=1.5@300000"]]'
    study = of_ones_own(tmp_path, analyses)
    two = replace(study, tasks=("HalfCheetah-v4", "Hopper-v4"))
    assert len(comparisons(two, gather(two, MadeRecords(made)))) == 3
    assert claims_of(two) == claims_of(study)


def test_a_lone_seed_is_near_to_nothing():
    study = mujoco(algorithms=["CSAC (paper)", "sac"])
    arms = gather(study.narrowed(seeds=1), MadeRecords(made))
    nearer = next(one for one in comparisons(study, arms) if "nearer to their mean" in one.claim)
    assert len(nearer.ours) == len(nearer.others) == 0


def test_an_odd_number_of_seeds_can_be_nearer_together():
    def value(cell, step):
        return 6_000 + (100 if cell.algorithm == "sac" else 1) * (0, 3, 4, 8, 20)[cell.seed]

    study = mujoco(algorithms=["CSAC (paper)", "sac"])
    nearer = next(
        one for one in comparisons(study, gather(study, MadeRecords(value))) if "nearer to their mean" in one.claim
    )
    assert nearer.ours.tolist() == [-7, -4, -3, -1, -13]
    assert decide(nearer).verdict == "reproduced"


def test_friction_that_changes_at_another_step_decides_nothing(tmp_path):
    """The paper changes it at step 300,000; the seeds would decide, if the change did not come sooner."""
    sooner, when = (
        claims_of(
            of_ones_own(
                tmp_path, f'steps = 1_000_000\nanalyses = ["robustness"]\nconditions = [[], ["friction=1.5@{step}"]]'
            )
        )
        for step in (100_000, 300_000)
    )
    assert len(sooner) == len(when) > 0
    assert set(sooner.values()) == {"not yet decidable"}
    assert "reproduced" in when.values()


def test_returns_are_claimed_of_tasks_that_nothing_perturbs(tmp_path):
    study = 'steps = 1_000_000\nanalyses = ["returns", "efficiency"]\n'
    plain, perturbed = (
        claims_of(of_ones_own(tmp_path, f"{study}conditions = {conditions}"))
        for conditions in ("[[]]", '[[], ["friction=1.5@300000"]]')
    )
    assert plain == perturbed
    assert plain


def test_a_study_of_one_s_own_with_every_analysis_has_a_report(tmp_path):
    conditions = '[[], ["friction=1.5@30000"]]'
    text = f"steps = 100_000\nseeds = 2\nrollouts = 2\nconditions = {conditions}\nanalyses = {list(ANALYSES)}"
    study = of_ones_own(tmp_path, text, '[[methods]]\nlabel = "mine"\nalgorithm = "td3"')
    assert "friction x 1.5 after step 30,000" in markdown_of([study], MadeRecords(made), tmp_path)


# Arms.


def test_arms_merge_seeds_and_tell_what_is_missing():
    source = MadeRecords(
        lambda cell, step: None if cell.seed == 4 else made(cell, step),
        lambda cell: "step 100: critic is not finite" if cell.seed == 1 else "",
    )
    arm = gather(mujoco(algorithms=["sac"]), source)[0]
    assert set(arm.rows["seed"]) == {0, 2, 3}
    assert (arm.failures, arm.missing) == ({1: "step 100: critic is not finite"}, [4])
    over, (values, step) = arm.maximum(), arm.best()
    assert (step, values.tolist()) == (1_000_000, [5_000, 5_020, 5_030])
    assert over.mean == pytest.approx(np.mean([5_000, 5_020, 5_030]))
    assert over.std == pytest.approx(np.std([5_000, 5_020, 5_030], ddof=1))


def test_interactions_to_the_lower_boundary():
    arms = gather(mujoco(), MadeRecords(made))
    by_label = {arm.label: arm for arm in arms}
    boundary = lower_boundary(arms)
    assert boundary == 1_020  # PPO's, the mean of its five seeds
    # 6,000 at 1M steps and an evaluation every 50,000: 1,020 is reached at 200,000 (1,200), after 150,000 (900).
    assert interactions(by_label["CSAC (paper)"], boundary).tolist() == [200_000] * 5
    # Of PPO, seeds 0 and 1 end below the mean of all five.
    assert interactions(by_label["PPO"], boundary).tolist() == [np.inf, np.inf, 1e6, 1e6, 1e6]


def test_an_arm_of_which_there_is_nothing(tmp_path):
    study = mujoco(algorithms=["sac"])
    source = MadeRecords(lambda *_: None)
    assert isinstance(gather(study, source)[0], Arm)
    text = markdown_of([study], source, tmp_path)
    assert "0 of 5 cells are complete, 5 are not over." in text
    assert "## Hyperparameters" in text


# The report.


def test_published_numbers_stand_beside_measured_ones(tmp_path):
    text = markdown_of([mujoco()], MadeRecords(made), tmp_path)
    assert "| SAC | 11,052.89 ± 422.84 | 5,020 ± 16 | 1,000,000 | 5 |" in text
    assert "| CSAC (periodic) |  | 6,020 ± 16 | 1,000,000 | 5 |" in text
    assert "| CSAC (paper) has or shows | verdict | because |" in text
    assert "| HalfCheetah-v4: a higher maximum average return than PPO | reproduced |" in text
    assert "30 of 30 cells are complete." in text
    assert "csac train HalfCheetah-v4 --algorithm csac --steps 1000000 --seeds 5 --evaluation-interval 5000" in text
    assert "--reference-policy periodic --reference-rate 0.005" in text
    assert "scale" not in text


def test_a_shortened_report_says_so_everywhere(tmp_path):
    text = markdown_of([mujoco().shortened(0.1)], MadeRecords(made), tmp_path)
    assert "**Every run is shortened to 0.1 of its steps.**" in text
    headings = [line for line in text.splitlines() if line.startswith("## ")]
    assert headings[:3] == [
        "## Learning curves (scale 0.1)",
        "## Maximum average returns (scale 0.1)",
        "## The paper's claims (scale 0.1)",
    ]
    assert "| reproduced |" not in text
    assert (tmp_path / "mujoco-curve-halfcheetah-v4-scale-0.1.png").exists()


def test_the_command_of_an_arm_trains_every_seed_of_it():
    arm = gather(mujoco(algorithms=["sac"], seeds=2), MadeRecords(made))[0]
    assert "--seeds 2 --evaluation-interval" in train_command(arm)
    arm.manifests = [replace(one, seeds=(100 + one.seeds[0],)) for one in arm.manifests]
    arm.missing, arm.failures = [102], {103: "critic is not finite"}
    assert "--seeds 4 --first-seed 100 --evaluation-interval" in train_command(arm)


def test_settings_are_the_words_of_a_command():
    default = {"steps": 1, "entropy_weight": 0.2, "sizes": (8, 8), "is_new": False, "is_old": True, "bound": 0.5}
    given = {"entropy_weight": "auto", "sizes": (8, 16), "is_new": True, "is_old": False}
    words = "--entropy-weight auto --sizes 8 16 --is-new --no-is-old"
    assert changed({**default, **given}, default) == words.split()
    assert changed({**default, "sizes": [4]}, default) == ["--sizes", "4"], "as JSON has it"
    assert changed({**default, "bound": None}, default) == [], "nothing that can be typed means none"


STUDIES = [name for name in NAMED if name not in ("reference", "smoke")]


@pytest.mark.parametrize("name", STUDIES)
def test_every_study_has_its_tables_and_pictures(whole, name):
    (_, text), directory = whole(name)
    pictures = {line.split("](")[1].split(")")[0] for line in text.splitlines() if line.startswith("![")}
    assert pictures
    assert all((directory / picture).stat().st_size > 10_000 for picture in pictures | _svg(pictures))
    wanted = {
        "mujoco": "![HalfCheetah-v4](mujoco-curve-halfcheetah-v4.png)",
        "ablation": "![Walker2d-v4, over tau](ablation-returns-walker2d-v4-over-tau.png)",
        "efficiency": "| CSAC (paper) | 105,000 | 200,000 | 5 of 5 |",
        "robustness": "![HalfCheetah-v4, friction](robustness-friction-halfcheetah-v4.png)",
        "quadx": "![PyFlyt/QuadX-Waypoints-v1, out of bounds, collision, env complete](quadx-cases-",
        "panda": "In the paper success is near 100 % for CSAC by 600k steps",
    }
    assert wanted[name] in text


def _svg(pictures):
    return {picture.replace(".png", ".svg") for picture in pictures}


def test_equal_records_give_equal_reports(tmp_path):
    study = mujoco(algorithms=["sac"])
    files = []
    for folder in ("one", "two"):
        write_report([study], MadeRecords(made), tmp_path / folder, [])
        files.append({path.name: path.read_bytes() for path in (tmp_path / folder).iterdir()})
    assert files[0] == files[1]


# The page.


class Reader(HTMLParser):
    """The text of a page, what it refers to, and the JSON of its plots."""

    def __init__(self, page):
        super().__init__()
        self.text, self.links, self.plots, self._is_plot, self._is_code = [], [], [], False, False
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.links += [values[name] for name in ("src", "href") if name in values]
        self._is_plot = tag == "script" and values.get("type") == "application/json"
        self._is_code = tag in ("script", "style")

    def handle_endtag(self, tag):
        self._is_plot = self._is_code = False

    def handle_data(self, data):
        if self._is_plot:
            self.plots.append(json.loads(data))
        elif not self._is_code:
            self.text.append(data)


@pytest.mark.parametrize("name", STUDIES)
def test_the_page_says_what_the_markdown_says(whole, name):
    (page, text), _ = whole(name)
    told = " ".join("".join(Reader(page).text).split())
    words = [cell for line in text.splitlines() for cell in re.split(r" ?\| ?|^#+ |^- |\*\*|^!\[|\]\(.*", line)]
    assert len(words) > 100
    assert [word for word in words if " ".join(word.split()) not in told and word.strip("-:`sh")] == []


@pytest.mark.parametrize("name", STUDIES)
def test_plotly_takes_every_plot(whole, name):
    (page, _), _ = whole(name)
    plots = Reader(page).plots
    panels = {"robustness": 3, "quadx": 4, "ablation": 3, "panda": 2}
    assert len(plots) == panels.get(name, 1)
    for plot in plots:
        plotly.graph_objects.Figure(plot)  # which raises what plotly.js would ignore
        assert all(len(trace["x"]) == len(trace["y"]) > 0 for trace in plot["data"])


def test_the_page_refers_to_nothing_outside(tmp_path):
    page, _ = page_of([mujoco(algorithms=["sac"])], tmp_path)
    links = Reader(page).links
    assert any(link.startswith("data:image/png;base64,") for link in links)
    assert [link for link in links if not link.startswith(("data:", "#"))] == []
    assert not re.search(r"@import|url\((?!#)", page[: page.index("</style>")])


def test_curves_on_the_page_have_the_numbers_of_the_rows(tmp_path):
    page, _ = page_of([mujoco(algorithms=["sac"])], tmp_path)
    (plot,) = Reader(page).plots
    band, mean = plot["data"]
    assert (mean["name"], mean["legendgroup"], band["legendgroup"]) == ("SAC (5 seeds)", "SAC", "SAC")
    assert (mean["x"][0], mean["y"][0]) == (50_000, 251)  # 5,020 / 20
    assert (mean["x"][-1], mean["y"][-1]) == (1_000_000, 5_020)
    deviation = np.std([0, 10, 20, 30, 40], ddof=1)
    assert (band["y"][19], band["y"][20]) == pytest.approx((5_020 + deviation, 5_020 - deviation), abs=1e-2)
    assert mean["text"][-1] == " (± standard deviation: 5,004.2 to 5,035.8)"


def test_labels_cannot_break_the_page(tmp_path):
    evil = "</script><script>alert(1)</script> {{ 7 * 7 }} & <b>"
    study = mujoco(algorithms=["sac"])
    study = replace(study, methods=(replace(study.methods[0], label=evil),), title=evil)
    page, _ = page_of([study], tmp_path)
    assert "<script>alert(1)" not in page
    assert evil in "".join(Reader(page).text)


@pytest.fixture
def figures(monkeypatch):
    """The figures that are drawn as PNG, in order."""
    drawn = []
    save = Figure.savefig
    monkeypatch.setattr(
        Figure,
        "savefig",
        lambda self, *a, **k: (drawn.append(self) if k["format"] == "png" else None, save(self, *a, **k)),
    )
    return drawn


def colours(figure):
    """The colour of each label in a drawn picture, without its seeds."""
    return {line.get_label().split(" (5")[0]: line.get_color() for line in figure.legends[0].get_lines()}


def test_a_method_has_one_colour_in_the_whole_report(tmp_path, figures):
    """Also where another before it has nothing to show, in the pictures and on the page."""

    def returns(cell, step):
        is_periodic = cell.algorithm == "csac" and cell.hyperparameters["reference_period"] != 1
        return None if is_periodic and cell.task == "Walker2d-v4" else made(cell, step)

    study = NAMED["mujoco"][0].narrowed(["HalfCheetah-v4", "Walker2d-v4"])
    path = write_report([replace(study, analyses=("curves",))], MadeRecords(returns), tmp_path, [])
    first, second = map(colours, figures)
    assert [label for label in first if label not in second] == ["CSAC (periodic)"]
    assert second.items() <= first.items()
    plots = Reader(path.read_text()).plots
    on_page = [{t["legendgroup"]: t["line"]["color"] for t in plot["data"] if "name" in t} for plot in plots]
    assert on_page == [first, second]


def test_swept_methods_keep_the_colour_that_they_have_in_another_study(tmp_path, figures):
    first, second = NAMED["mujoco"][0].narrowed(["Walker2d-v4"]), NAMED["ablation"][0]
    first = replace(first, methods=first.methods[::-1], analyses=("curves",))
    write_report([first, replace(second, analyses=("returns",))], MadeRecords(made), tmp_path, [])
    curves, over_tau = map(colours, figures)
    assert list(over_tau) == ["CSAC (paper)", "CSAC (periodic)"]
    assert over_tau.items() <= curves.items()


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("ablation", "lines: ± one standard deviation over seeds · 5 seeds"),
        ("efficiency", "bars: median seed · lines: range of the seeds that reach it · 5 seeds"),
        ("quadx", "lines: ± one standard deviation over seeds · 5 seeds"),
    ],
)
def test_pictures_say_what_their_vertical_lines_are(tmp_path, figures, name, told):
    (study,) = NAMED[name]
    page, _ = page_of([study.narrowed(tasks=study.tasks[:1])], tmp_path)
    drawn = [text.get_text() for figure in figures for text in (*figure.texts, *figure.axes[0].texts)]
    drawn = [text.replace("\n", " · ") for text in drawn]  # broken where there is no room
    assert drawn.count(told) == 1
    assert " ".join(Reader(page).text).count(told) == 1


def test_one_seed_has_no_vertical_lines(tmp_path):
    (study,) = NAMED["quadx"]
    page, _ = page_of([study.narrowed(seeds=1)], tmp_path)
    told = " ".join(Reader(page).text)
    assert "<small>1 seed</small>" in page
    assert "lines: ±" not in told


def test_success_is_a_share(tmp_path, figures):
    class Some(MadeRecords):
        def record(self, cell):
            record = super().record(cell)
            assert record
            record.evaluations["success"] = cell.seed < 3  # 0.6 ± 0.55
            return record

    study = NAMED["panda"][0].narrowed(algorithms=["sac"])
    path = write_report([replace(study, analyses=("success",))], Some(made), tmp_path, [])
    (plot,) = Reader(path.read_text()).plots
    assert plot["layout"]["yaxis"]["range"] == [-0.05, 1.05]
    assert figures[0].axes[0].get_ylim() == pytest.approx((-0.05, 1.05))
    assert (min(plot["data"][0]["y"]), max(plot["data"][0]["y"])) == pytest.approx((0.0523, 1.0), abs=1e-4)


def test_the_axis_of_steps_has_room_for_its_last_number(tmp_path, figures):
    page, _ = page_of([mujoco(algorithms=["sac"])], tmp_path)
    (plot,) = Reader(page).plots
    assert plot["layout"]["xaxis"]["range"] == [0, 1_015_000]
    assert figures[0].axes[0].get_xlim() == pytest.approx((0, 1_015_000))


def test_friction_stands_side_by_side(whole):
    (page, _), _ = whole("robustness")
    plots = Reader(page).plots
    marks = [plot["layout"]["annotations"][0]["text"].strip() for plot in plots]
    assert marks == ["friction x 1.5", "friction x 2", "friction x 2.5"]
    assert len({json.dumps(plot["layout"]["yaxis"]) for plot in plots}) == 1  # one scale


def test_the_paper_s_rollouts_stand_beside_ours(whole):
    (page, _), _ = whole("quadx")
    *bars, published = Reader(page).plots[1]["data"]
    assert {bar["name"]: bar["y"] for bar in bars}["CSAC (paper)"] == [0]  # as made: none is out of bounds
    assert dict(zip(published["x"], published["y"], strict=True))["SAC"] == 48.2


# The paper.


def test_the_paper_s_tables_agree_with_its_text():
    returns = paper.MAXIMUM_AVERAGE_RETURNS
    ratios = {task: columns["CSAC"].mean / columns["SAC"].mean - 1 for task, columns in returns.items()}
    told = {"HalfCheetah-v4": 0.056, "Walker2d-v4": 0.515, "Ant-v4": 0.059, "Hopper-v4": 0.139}
    assert ratios == pytest.approx(told, abs=6e-4)
    for task in returns:
        assert min(returns[task].values()).mean == returns[task]["PPO"].mean  # the lower boundary is PPO's
    fewer = {task: 1 - columns["CSAC"] / columns["SAC"] for task, columns in paper.INTERACTIONS.items()}
    assert fewer == pytest.approx(
        {"HalfCheetah-v4": 0.087, "Walker2d-v4": 0.503, "Ant-v4": 0.25, "Hopper-v4": 0.615}, abs=1e-3
    )
