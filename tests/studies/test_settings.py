"""The hyperparameters of a study, beside the paper's."""

from csac.record.rendering import Table, markdown
from csac.studies.named import NAMED
from csac.studies.parts import Paragraph
from csac.studies.settings import hyperparameters
from csac.studies.study import Method, Study


def told_of(study):
    """The rows of its tables, and its sentences."""
    parts = list(hyperparameters(study))
    tables = [part for part in parts if isinstance(part, Table)]
    text = " ".join(part.text for part in parts if isinstance(part, Paragraph))
    return [line for table in tables for line in markdown(table).splitlines()], text


def test_the_paper_s_table_stands_beside_ours():
    rows, text = told_of(NAMED["mujoco"][0])
    assert "| the paper's rows, our values | CSAC (paper) | SAC | PPO | TD3 | SD3 |" in rows
    assert "| Critic Learning Rate | 0.0003 | 0.0003 | 0.0003 | 0.0003 | 0.001 |" in rows
    assert "| Actor and Critic Structure | 256 256 | 256 256 | 64 64 | 256 256 | 256 256 |" in rows
    assert "| Batch Size | 256 | 256 | 64 (the paper: 32) | 256 | 256 |" in rows  # 2,048 transitions in 32 parts
    assert "| Memory Size | 1,000,000 | 1,000,000 |  | 1,000,000 | 1,000,000 |" in rows
    assert "| sigma | 0.2 |  |  |  |  |" in rows
    assert "| tau | 0.5 |  |  |  |  |" in rows
    assert "Different from the paper's: Batch Size of PPO. PPO's batch is its rollout" in text
    assert "shortened" not in text


def test_what_hangs_on_the_task_is_told_task_by_task():
    rows, _ = told_of(NAMED["mujoco"][0])
    assert "| inverse_temperature |  |  |  |  |  | by task |" in rows
    assert "| by task |  | HalfCheetah-v4 | Walker2d-v4 | Ant-v4 | Hopper-v4 |" in rows
    assert rows[-1] == "| SD3 | inverse_temperature | 0.005 | 0.1 | 0.001 | 0.05 |"


def test_a_shortened_warm_up_is_told_as_it_ran():
    # A hundredth of 1M steps is 10,000, of Hopper's 2M 20,000: warm-ups are 1,000 and 2,000.
    study = NAMED["mujoco"][0].narrowed(["Walker2d-v4", "Hopper-v4"], ["SAC", "PPO"])
    rows, text = told_of(study.shortened(0.01))
    whole = "(the paper: 1e4)"
    assert f"| Warmup Steps | 1,000 {whole} on Walker2d-v4; 2,000 {whole} on Hopper-v4 |  |" in rows
    assert rows[-1] == "| SAC | warmup_steps | 1,000 | 2,000 |"
    assert "Different from the paper's: Batch Size of PPO, Warmup Steps of SAC." in text
    assert "told as it ran" in text
    rows, text = told_of(study.shortened(0.1))  # a tenth of 100,000 is the whole warm-up
    assert "| Warmup Steps | 10,000 |  |" in rows


def test_other_weights_than_the_paper_s_are_seen():
    rows, text = told_of(NAMED["quadx"][0].narrowed(algorithms=["csac"]))
    assert "| tau | 0.1 |" in rows  # which the paper has on this task alone
    assert "All are the paper's." in text
    changed = Study(
        "own", "Own", ("Hopper-v4",), (Method("it", "csac", hyperparameters={"entropy_weight": 0.3}, published="CSAC"),)
    )
    assert "| sigma | 0.3 (the paper: 0.2) |" in told_of(changed)[0]


def test_swept_weights_are_the_paper_s():
    rows, text = told_of(NAMED["ablation"][0])
    assert "| tau | 0.005 | 0.05 | 0.5 | 5 | 50 |" in rows
    assert "All are the paper's." in text


def test_a_study_without_the_paper_s_methods_has_ours_alone():
    rows, text = told_of(Study("own", "Own", ("Hopper-v4",), (Method("it", "sac"),)))
    assert rows[0] == "| on Hopper-v4 | it |"
    assert "paper" not in " ".join([*rows, text])
