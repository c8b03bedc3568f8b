"""Cells on a real Ray cluster of several nodes on this machine."""

import pytest
from resuming import contents
from studying import cell, jobs

from csac.record.run import RunDirectory
from csac.studies.cells import Store
from csac.studies.cluster import Request, run_on_ray
from csac.studies.engines import run_here
from csac.studies.job import Advanced, Ended, Started
from csac.types import InputError

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]

STEPS = 6_000


@pytest.fixture
def cluster():
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "object_store_memory": 100 * 2**20})
    yield cluster
    cluster.shutdown()


def test_a_node_that_is_lost_in_mid_run_loses_nothing(tmp_path, cluster, monkeypatch):
    # Messages are looked at often, so that the node is lost while its cell runs, however fast the machine is.
    monkeypatch.setattr("csac.studies.cluster.SECONDS_BETWEEN_LOOKS", 0.05)
    three = jobs(tmp_path / "ray", *(cell(seed, steps=STEPS) for seed in range(3)))
    nodes = [cluster.add_node(num_cpus=1, object_store_memory=100 * 2**20) for _ in range(2)]
    messages, places, interrupted = [], {}, []

    def tell(message):
        messages.append(message)
        if isinstance(message, Started):
            places.setdefault(message.key, []).append(message.where.split()[-1])
        if isinstance(message, Advanced) and message.step >= 500 and len(cluster.worker_nodes) == 2 and nodes:
            (lost,) = [node for node in nodes if node.node_id.startswith(places[message.key][-1])]
            nodes.clear()
            interrupted.append(message.key)
            cluster.remove_node(lost, allow_graceful=False)

    run_on_ray(three, tell, cluster.address, Request())
    assert {message.key: message.outcome for message in messages if isinstance(message, Ended)} == {
        job.cell.key: "complete" for job in three
    }
    (again,) = [job for job in three if RunDirectory.open(job.path).manifest.history]
    assert [again.cell.key] == interrupted
    assert len(set(places[again.cell.key])) == 2
    (entry,) = RunDirectory.open(again.path).manifest.history
    assert entry.step >= 360
    for job, alone in zip(three, jobs(tmp_path / "alone", *(job.cell for job in three)), strict=True):
        run_here([alone], lambda _: None)
        assert contents(job.path) == contents(alone.path)
    assert Store(tmp_path / "ray").status(again.cell).state == "complete"


def test_no_cluster_at_the_address(tmp_path):
    with pytest.raises(InputError, match=r"no Ray cluster can be reached at 127\.0\.0\.1:1"):
        run_on_ray(jobs(tmp_path, cell()), lambda _: None, "127.0.0.1:1", Request())
