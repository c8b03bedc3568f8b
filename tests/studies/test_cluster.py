"""Cells on a real Ray cluster of several nodes on this machine, and what a task of it does, without one."""

import sys
from contextlib import ExitStack, nullcontext
from types import SimpleNamespace

import pytest
from resuming import contents
from shown import Clock
from studying import cell, jobs, make_run

from csac.record.run import RunDirectory
from csac.studies import cluster as module
from csac.studies.cells import Store
from csac.studies.cluster import Request, run_on_ray
from csac.studies.engines import run_here
from csac.studies.job import Advanced, Ended, Started
from csac.types import InputError

STEPS = 6_000


@pytest.fixture
def cluster():
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "object_store_memory": 100 * 2**20})
    yield cluster
    cluster.shutdown()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
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


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_no_cluster_at_the_address(tmp_path):
    with pytest.raises(InputError, match=r"no Ray cluster can be reached at 127\.0\.0\.1:1"):
        run_on_ray(jobs(tmp_path, cell()), lambda _: None, "127.0.0.1:1", Request())


@pytest.mark.parametrize(
    ("attempt", "held", "outcome", "waited"),
    [(0, 100, "elsewhere", 0), (1, 100, "complete", 100), (2, 10_000, "elsewhere", 300)],
)
def test_what_ray_tries_again_waits_for_the_lock_of_the_node_that_was_lost(
    tmp_path, monkeypatch, attempt, held, outcome, waited
):
    (job,) = jobs(tmp_path, cell())
    clock, lock = Clock(), ExitStack()
    lock.enter_context(make_run(Store(tmp_path), job.cell, state="finished").locked())
    began = clock()

    def sleep(seconds):
        clock.now += seconds
        if clock() - began >= held:
            lock.close()

    context = SimpleNamespace(
        get_node_id=lambda: "a1b2c3d4",
        worker=SimpleNamespace(core_worker=SimpleNamespace(get_current_task_attempt_number=lambda: attempt)),
    )
    ray = SimpleNamespace(get_runtime_context=lambda: context, wait=lambda sent, **_: None)
    messages = SimpleNamespace(actor=SimpleNamespace(put=SimpleNamespace(remote=lambda message: message)))
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=clock, sleep=sleep))
    monkeypatch.setattr(module, "_Cores", nullcontext)
    with lock:
        assert module._work(job, 1, messages).outcome == outcome
    assert clock() - began == waited


def test_without_ray_one_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(InputError, match=r"^Ray is not installed: pip install '\.\[cluster\]' in a clone of csac$"):
        run_on_ray(jobs(tmp_path, cell()), print, None, Request())
