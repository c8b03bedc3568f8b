"""Runs on a real Ray cluster of several nodes on this machine."""

import sys

import pytest
from resuming import contents
from studying import tiny_study

from csac.console.tables import make_console
from csac.record.run import RunDirectory
from csac.studies.ray import Cluster
from csac.studies.run import Execution, Progress, run_study
from csac.types import InputError


def test_without_ray_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"pip install '\.\[cluster\]'"):
        run_study(tiny_study(tmp_path).runs(), tmp_path, Execution(cluster=Cluster()), make_console())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_node_that_is_lost_in_mid_run_loses_nothing(tmp_path, monkeypatch):
    """Of two nodes with a run each one is lost: its run goes on from a checkpoint, to the same numbers."""
    from ray.cluster_utils import Cluster as RayCluster

    study = tiny_study(tmp_path, tasks=["HalfCheetah-v4"], steps=6_000, evaluation_interval=1_000)
    runs = [run for run in study.runs() if run.method.algorithm == "sac"]
    cluster = RayCluster(initialize_head=True, head_node_args={"num_cpus": 0, "object_store_memory": 100 * 2**20})
    nodes = [cluster.add_node(num_cpus=1, object_store_memory=100 * 2**20) for _ in range(2)]
    advanced = Progress.advanced

    def advance(self, path, step):
        advanced(self, path, step)
        if nodes and all(step >= 2_000 for step in self.done.values()):
            cluster.remove_node(nodes.pop(), allow_graceful=False)
            nodes.clear()

    monkeypatch.setattr(Progress, "advanced", advance)
    monkeypatch.setattr("csac.training.loop.SECONDS_BETWEEN_CHECKPOINTS", 0.0)
    try:
        run_study(runs, tmp_path / "ray", Execution(cluster=Cluster(cluster.address)), make_console())
    finally:
        cluster.shutdown()
    run_study(runs, tmp_path / "alone", Execution(), make_console())
    found = [RunDirectory.open(tmp_path / "ray" / run.folder) for run in runs]
    assert [run.state for run in found] == ["finished"] * 2
    assert sum(bool(run.manifest.history) for run in found) == 1
    for run, one in zip(runs, found, strict=True):
        assert contents(one) == contents(RunDirectory.open(tmp_path / "alone" / run.folder))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_no_cluster_at_the_address(tmp_path):
    with pytest.raises(InputError, match=r"127\.0\.0\.1:1"):
        run_study(tiny_study(tmp_path).runs(), tmp_path, Execution(cluster=Cluster("127.0.0.1:1")), make_console())
