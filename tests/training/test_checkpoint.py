"""Checkpoints come back as they were written; whatever else is found in their place is called by its name."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import resource
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
import trainer  # noqa: F401  (its cache of compiled programs)
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from csac import cli
from csac.algorithms import CSAC
from csac.deploy.contract import Contract
from csac.deploy.policy import Policy
from csac.record.manifest import Manifest, Origin
from csac.record.run import RunDirectory
from csac.record.tensorboard import TensorBoardLog
from csac.tasks.seeds import SeedEnvironments
from csac.training.checkpoint import (
    SCHEMA_VERSION,
    Checkpoint,
    Checkpoints,
    Damaged,
    Unread,
    newest_sound,
    remove_unfinished,
    steps_in,
)
from csac.training.seed_files import SeedFiles
from csac.training.train import resume, train
from csac.types import InputError, Ring, Snapshot

WIDTH = 3
few = settings(max_examples=25)
names = st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1, max_size=8).filter(
    lambda name: name != "__metadata__"
)
dtypes = st.sampled_from(["float32", "float64", "float16", "int32", "int64", "uint32", "uint8", "bool"])
arrays = dtypes.flatmap(lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=3, min_side=0)))
json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**30), 10**30) | st.floats(allow_nan=False) | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)


@contextmanager
def folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


def ring(capacity: int, count: int) -> Ring:
    """A memory to which transition i = [i, i, i] was added for every i below `count`."""
    rows = np.zeros((capacity, WIDTH), np.float32)
    for i in range(max(0, count - capacity), count):
        rows[i % capacity] = i
    return Ring(rows, count)


def save(place: Path, step: int, seeds=(0,), keep: int = 0, capacity: int = 50) -> Checkpoints:
    """Commit a checkpoint with `step` transitions of each seed, going on from the newest one in the folder."""
    before = max(steps_in(place), default=None)
    known = Checkpoint.open(place, before).files if before else {}
    files = {}
    for seed in seeds:
        learnt = Snapshot({"weight": np.full((2, 2), step, np.float32)}, {"step": step})
        files |= SeedFiles(place, seed, known).write(step, learnt, ring(capacity, step))
    checkpoints = Checkpoints(place, keep)
    checkpoints.commit(step, files, {"step": step, "told": "all that the run notes down"})
    return checkpoints


# Round trips.


@few
@given(st.dictionaries(names, arrays, max_size=4), st.dictionaries(st.text(max_size=8), json_values, max_size=3))
def test_arrays_and_values_come_back_bit_for_bit(saved, values):
    with folder() as place:
        files = SeedFiles(place, 7, {}).write(3, Snapshot(saved, values), ring(4, 0))
        Checkpoints(place, 1).commit(3, files, {"note": values})
        checkpoint = Checkpoint.open(place, 3)
        again = checkpoint.seed(7)
        assert checkpoint.values["note"] == values == again.values
        assert again.arrays.keys() == saved.keys()
        for name, array in saved.items():
            assert (again.arrays[name].dtype, again.arrays[name].shape) == (array.dtype, array.shape)
            assert again.arrays[name].tobytes() == array.tobytes()


def test_arrays_in_another_order_of_axes_come_back():
    with folder() as place:
        transposed = np.arange(6.0).reshape(2, 3).T
        files = SeedFiles(place, 0, {}).write(1, Snapshot({"x": transposed}, {}), ring(4, 0))
        Checkpoints(place, 1).commit(1, files, {})
        np.testing.assert_array_equal(Checkpoint.open(place, 1).seed(0).arrays["x"], transposed)


@few
@given(st.integers(1, 12), st.lists(st.integers(0, 30), min_size=1, max_size=5), st.booleans())
def test_the_newest_transitions_come_back_from_every_checkpoint(capacity, added, restarted):
    """Whatever was added between checkpoints, and whether another process wrote the earlier ones."""
    with folder() as place:
        seed_files, count = SeedFiles(place, 1, {}), 0
        for step, more in enumerate(added, start=1):
            count += more
            files = seed_files.write(step, Snapshot({}, {}), ring(capacity, count))
            Checkpoints(place, 1).commit(step, files, {})
            checkpoint = Checkpoint.open(place, step)
            checkpoint.verify()
            rows = np.zeros((capacity, WIDTH), np.float32)
            checkpoint.memory(1, rows)
            np.testing.assert_array_equal(rows, ring(capacity, count).rows)
            if restarted:
                seed_files = SeedFiles(place, 1, checkpoint.files)


def test_transitions_come_back_into_a_larger_memory():
    with folder() as place:
        save(place, 10, capacity=10)
        rows = np.zeros((16, WIDTH), np.float32)
        Checkpoint.open(place, 10).memory(0, rows)
        np.testing.assert_array_equal(rows[:, 0], [*range(10), *[0] * 6])


def test_a_checkpoint_costs_what_is_new_however_much_there_is():
    """Each adds 10 transitions of 12 bytes, whether 0 or 980 are there already."""
    with folder() as place:
        seed_files, costs = SeedFiles(place, 0, {}), []
        for step in range(10, 1000, 10):
            before = set(place.rglob("*"))
            seed_files.write(step, Snapshot({"x": np.zeros(5)}, {}), ring(2000, step))
            costs.append(sum(path.stat().st_size for path in set(place.rglob("*")) - before if path.is_file()))
        assert max(costs) - min(costs) <= 8  # the header is padded to eight bytes


# Damage.


def step_files(place: Path) -> list[Path]:
    checkpoint = Checkpoint.open(place, 20)
    return [place / "step_20.json", *(place / name for name in checkpoint.files)]


@few
@given(st.data())
def test_any_flipped_bit_is_found_and_its_file_named(data):
    with folder() as place:
        save(place, 10)
        save(place, 20)
        victim, before = data.draw(st.sampled_from(step_files(place))), Checkpoint.open(place, 20)
        content = bytearray(victim.read_bytes())
        content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
        victim.write_bytes(content)
        check_found(place, victim, before)


@few
@given(st.data())
def test_any_cut_is_found_and_its_file_named(data):
    with folder() as place:
        save(place, 10)
        save(place, 20)
        victim, before = data.draw(st.sampled_from(step_files(place))), Checkpoint.open(place, 20)
        os.truncate(victim, data.draw(st.integers(0, victim.stat().st_size - 1)))
        check_found(place, victim, before)


def check_found(place: Path, victim: Path, before: Checkpoint) -> None:
    """The damaged checkpoint is refused and the one before it used, or what both share is mended."""
    checkpoint, complaints = newest_sound(place)
    assert checkpoint
    if checkpoint.step == 10:
        assert victim.name in complaints[0]
        return
    if victim.suffix == ".json":  # which may say the same in other bytes: a space of another kind
        assert (checkpoint.files, checkpoint.values) == (before.files, before.values)
        return
    assert checkpoint.mended == ({f"replay/{victim.name}"} if victim.suffix == ".safetensors" else set())
    rows = np.zeros((50, WIDTH), np.float32)
    checkpoint.memory(0, rows)
    np.testing.assert_array_equal(rows, ring(50, 20).rows)


def test_a_list_with_a_flipped_bit_is_refused_or_says_the_same(tmp_path):
    save(tmp_path, 20)
    path, before = tmp_path / "step_20.json", Checkpoint.open(tmp_path, 20)
    content = path.read_bytes()
    for bit in range(8 * len(content)):
        path.write_bytes((int.from_bytes(content) ^ 1 << bit).to_bytes(len(content)))
        with suppress(Damaged):
            again = Checkpoint.open(tmp_path, 20)
            assert (again.files, again.values) == (before.files, before.values)


def test_transitions_without_a_parity_are_refused_where_they_are_damaged(tmp_path):
    save(tmp_path, 10)
    save(tmp_path, 20)
    (tmp_path / "replay" / "seed_0.0-10.parity").unlink()
    victim = tmp_path / "replay" / "seed_0.0-10.safetensors"
    victim.write_bytes(victim.read_bytes()[:-1])
    checkpoint, complaints = newest_sound(tmp_path)
    assert checkpoint is None
    assert all(victim.name in complaint for complaint in complaints)


def test_blocks_that_the_disk_cannot_read_are_mended(tmp_path, monkeypatch):
    """As a disk tells of a bad sector: reading it, alone or with others, is an error."""
    save(tmp_path, 2000, capacity=2000)
    path, read_bytes, pread = tmp_path / "replay" / "seed_0.0-2000.safetensors", Path.read_bytes, os.pread
    content = path.read_bytes()

    def read_all(self: Path) -> bytes:
        if self == path:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return read_bytes(self)

    def read_block(descriptor: int, size: int, place: int) -> bytes:
        if place == 8192:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return pread(descriptor, size, place)

    monkeypatch.setattr(Path, "read_bytes", read_all)
    monkeypatch.setattr(os, "pread", read_block)
    checkpoint = Checkpoint.open(tmp_path, 2000)
    assert checkpoint.read(f"replay/{path.name}") == content
    assert checkpoint.mended == {f"replay/{path.name}"}


@pytest.mark.parametrize("name", ["step_20.json", "step_20.seed_0.safetensors", "replay/seed_0.10-20.safetensors"])
def test_a_file_that_could_not_be_read_this_time_is_no_damage(tmp_path, monkeypatch, name):
    """An earlier checkpoint took the place of the newest one, which was then removed, for one failed read."""
    for step in (10, 20):
        save(tmp_path, step, keep=2)
    read_bytes = Path.read_bytes

    def read(self: Path) -> bytes:
        if self == tmp_path / name:
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))
        return read_bytes(self)

    monkeypatch.setattr(Path, "read_bytes", read)
    with pytest.raises(Unread, match=rf"{name} cannot be read: Stale file handle; the same line goes on once"):
        newest_sound(tmp_path)


def test_a_checkpoint_of_another_schema_is_no_damage(tmp_path):
    for step in (10, 20):
        save(tmp_path, step, keep=2)
    fields = json.loads((tmp_path / "step_20.json").read_text())
    del fields["sha256"]
    fields["schema_version"] += 1
    checksum = hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()
    (tmp_path / "step_20.json").write_text(json.dumps({**fields, "sha256": checksum}))
    with pytest.raises(Unread, match="go on with the csac that wrote it"):
        newest_sound(tmp_path)


def test_transitions_that_are_missing_are_told(tmp_path):
    """Whoever signs a list may leave out a file; training would go on with zeros in its place."""
    save(tmp_path, 10)
    save(tmp_path, 20)
    checkpoint = Checkpoint.open(tmp_path, 20)
    rows = np.zeros((50, WIDTH), np.float32)
    for name, message in (("0-10", "lacks the transitions 0 to 9"), ("10-20", "has 10 transitions .*, not 20")):
        files = {key: facts for key, facts in checkpoint.files.items() if name not in key}
        with pytest.raises(Damaged, match=message):
            Checkpoint(tmp_path, 20, files, {}).memory(0, rows)


def test_a_missing_file_is_named():
    with folder() as place:
        save(place, 10)
        (place / "step_10.seed_0.safetensors").unlink()
        with pytest.raises(Damaged, match=r"step_10\.seed_0\.safetensors cannot be read: No such file"):
            Checkpoint.open(place, 10).verify()


# Strangers: their checksums may be right.


def forge(place: Path, fields: Any) -> None:
    """Write step_5.json with these fields and the checksum that belongs to them."""
    checksum = hashlib.sha256(json.dumps(fields, sort_keys=True).encode()).hexdigest()
    (place / "step_5.json").write_text(json.dumps({**fields, "sha256": checksum}))


def forged(content: bytes, name: str) -> dict[str, Any]:
    return {"schema_version": SCHEMA_VERSION, "step": 5, "files": {name: facts_of(content)}, "values": {}}


def facts_of(content: bytes) -> dict[str, Any]:
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def forge_transitions(place: Path, content: bytes, first: int, last: int) -> None:
    """Write a checkpoint of seed 0 that has this file of transitions alone."""
    (place / "replay").mkdir()
    name, held = f"replay/seed_0.{first}-{last}.safetensors", [first, last]
    (place / name).write_bytes(content)
    learnt = safetensors.numpy.save({}, metadata={"saved": json.dumps({"values": {}, "transitions": held})})
    (place / "step_5.seed_0.safetensors").write_bytes(learnt)
    fields = forged(content, name)
    fields["files"]["step_5.seed_0.safetensors"] = facts_of(learnt)
    forge(place, fields)


def use_all(place: Path, memory: np.ndarray) -> Snapshot:
    checkpoint = Checkpoint.open(place, 5)
    checkpoint.verify()
    checkpoint.memory(0, memory)
    return checkpoint.seed(0)


@few
@given(st.binary(max_size=200) | json_values.map(lambda value: json.dumps(value).encode()))
def test_bytes_in_place_of_a_checkpoint_are_damage(content):
    with folder() as place:
        (place / "step_5.json").write_bytes(content)
        with pytest.raises(Damaged):
            Checkpoint.open(place, 5)


@few
@given(st.sampled_from(["step", "files", "values"]), json_values)
def test_fields_of_any_other_kind_are_damage(field, value):
    with folder() as place:
        save(place, 5)
        fields = json.loads((place / "step_5.json").read_text())
        del fields["sha256"]
        forge(place, {**fields, field: value})
        try:
            Checkpoint.open(place, 5).seed(0)
        except Damaged:
            return
        assert field == "values" or value == fields[field]


@pytest.mark.parametrize(
    "name",
    [
        "../../secret.safetensors",
        "/etc/passwd",
        "replay/../../x.safetensors",
        f"replay/seed_0.0-{10**20}.safetensors",
        f"replay/seed_0.{'9' * 5000}-1.safetensors",
        "step_5.seed_٣.safetensors",
    ],
)
def test_names_that_lead_elsewhere_are_damage(tmp_path, name):
    forge(tmp_path, forged(b"", name))
    with pytest.raises(Damaged, match="is no file of a checkpoint"):
        Checkpoint.open(tmp_path, 5)


@few
@given(
    st.binary(max_size=100)
    | json_values.map(lambda value: (text := json.dumps(value).encode(), len(text).to_bytes(8, "little") + text)[1])
    | st.tuples(
        st.sampled_from(["F32", "BF16", "F8_E4M3", "U16", "??"]), st.lists(st.integers(0, 2**40), max_size=3)
    ).map(lambda facts: tensor_header(*facts)),
    st.sampled_from([None, 2, 999999999999999]),
)
def test_bytes_in_place_of_arrays_are_damage(content, transitions):
    """Also headers that claim more than there is: nothing is allocated for them."""
    with folder() as place:
        if transitions:
            forge_transitions(place, content, 0, transitions)
        else:
            (place / "step_5.seed_0.safetensors").write_bytes(content)
            forge(place, forged(content, "step_5.seed_0.safetensors"))
        memory = np.zeros((4, WIDTH), np.float32)
        with suppress(Damaged):  # four bytes can be a scalar
            assert sum(array.nbytes for array in use_all(place, memory).arrays.values()) <= len(content)
        assert not memory.any()


def tensor_header(kind: str, shape: list[int]) -> bytes:
    values = {"rows": {"dtype": kind, "shape": shape, "data_offsets": [0, 4]}, "__metadata__": {"values": "{}"}}
    text = json.dumps(values).encode()
    return len(text).to_bytes(8, "little") + text + bytes(4)


@few
@given(first=st.integers(0, 10**15 - 3), shape=st.tuples(st.integers(0, 3), st.integers(0, 4)))
def test_transitions_of_another_shape_are_damage(first, shape):
    with folder() as place:
        content = safetensors.numpy.save({"rows": np.ones(shape, np.float32)})
        forge_transitions(place, content, first, first + 2)
        memory = np.zeros((4, WIDTH), np.float32)
        if shape == (2, WIDTH):
            Checkpoint.open(place, 5).memory(0, memory)
            assert memory.sum() == 2 * WIDTH
        else:
            with pytest.raises(Damaged, match="does not fit"):
                Checkpoint.open(place, 5).memory(0, memory)


@few
@given(st.binary(max_size=300))
def test_random_bytes_are_no_run_no_contract_and_no_policy(content):
    with folder() as place:
        path = place / "manifest.json"
        path.write_bytes(content)
        for read in (
            lambda: RunDirectory.open(place),
            lambda: Contract.load(path),
            lambda: Policy.load(path, path),
        ):
            with pytest.raises(InputError, match=r"manifest\.json"):
                read()


# Pruning.


def test_the_newest_are_kept_with_what_they_need_and_nothing_else(tmp_path):
    for step in (10, 20, 30, 40):
        save(tmp_path, step, seeds=(0, 1), keep=2, capacity=15)
    assert steps_in(tmp_path) == [30, 40]
    for step in (30, 40):
        Checkpoint.open(tmp_path, step).verify()
    # A memory of 15 at step 30 begins with transition 15: the file of 10 to 20 is needed, that of 0 to 10 is not.
    firsts = {path.name.split(".")[1] for path in (tmp_path / "replay").iterdir()}
    assert firsts == {"10-20", "20-30", "30-40"}


def test_zero_keeps_all(tmp_path):
    for step in (10, 20, 30):
        save(tmp_path, step, keep=0)
    assert steps_in(tmp_path) == [10, 20, 30]
    for step in (10, 20, 30):
        Checkpoint.open(tmp_path, step).verify()


def test_what_a_list_that_cannot_be_read_may_need_stays(tmp_path):
    """A disk may fail for a moment, and a person may mend the list."""
    for step in (10, 20):
        save(tmp_path, step, seeds=(0, 1), keep=2)
    path = tmp_path / "step_20.json"
    content = path.read_bytes()
    path.write_bytes(b"")
    files = {}
    for seed in (0, 1):
        files |= SeedFiles(tmp_path, seed, {}).write(30, Snapshot({}, {}), ring(50, 30))
    Checkpoints(tmp_path, 2).commit(30, files, {})
    path.write_bytes(content)
    for step in (20, 30):
        Checkpoint.open(tmp_path, step).verify()
    assert steps_in(tmp_path) == [20, 30]


def test_failures_of_seeds_whose_order_as_texts_is_another_are_no_damage(tmp_path):
    failures = {2: "a reward is NaN", 10: "killed"}
    Checkpoints(tmp_path, 1).commit(12, {}, {"failures": failures})
    assert Checkpoint.open(tmp_path, 12).values["failures"] == {"2": "a reward is NaN", "10": "killed"}


def test_a_commit_leaves_alone_what_a_group_ahead_has_written(tmp_path):
    save(tmp_path, 10)
    ahead = SeedFiles(tmp_path, 1, {}).write(30, Snapshot({}, {}), ring(50, 30))
    save(tmp_path, 20, keep=1)
    assert steps_in(tmp_path) == [20]
    assert all((tmp_path / name).exists() for name in ahead)


def test_a_pinned_checkpoint_stays(tmp_path):
    checkpoints = save(tmp_path, 10)
    checkpoints.keep = 1
    checkpoints.pin_newest()
    for step in (20, 30):
        files = SeedFiles(tmp_path, 0, {}).write(step, Snapshot({}, {}), ring(50, step))
        checkpoints.commit(step, files, {})
    assert steps_in(tmp_path) == [10, 30]
    Checkpoint.open(tmp_path, 10).verify()


def test_what_an_interrupted_write_left_is_removed(tmp_path):
    save(tmp_path, 10)
    kept = {path for path in tmp_path.rglob("*") if path.is_file()}
    SeedFiles(tmp_path, 0, Checkpoint.open(tmp_path, 10).files).write(20, Snapshot({}, {}), ring(50, 20))
    (tmp_path / ".step_20.json.4711").write_bytes(b"{")
    (tmp_path / "replay" / ".seed_0.20-30.safetensors.4711").write_bytes(b"\0")
    checkpoints = Checkpoints(tmp_path, 2)
    checkpoints.discard_after(10)
    assert checkpoints.newest == 10
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == kept


def test_a_hidden_folder_of_somebody_else_s_stays(tmp_path):
    """Of Jupyter, say. To remove it as a file was an error each time that the run went on."""
    save(tmp_path, 10)
    (tmp_path / ".ipynb_checkpoints").mkdir()
    (tmp_path / ".ipynb_checkpoints" / "notes.txt").touch()
    (tmp_path / ".step_20.json.4711").touch()
    Checkpoints(tmp_path, 2).discard_after(10)
    assert (tmp_path / ".ipynb_checkpoints" / "notes.txt").exists()
    assert not (tmp_path / ".step_20.json.4711").exists()


# What the documentation shows.


def test_the_environment_of_the_documentation_can_be_saved(tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "reliability.md").read_text()
    shown: dict[str, Any] = {}
    exec(text.split("```python\n")[1].split("```")[0], shown)
    first, second = (SeedEnvironments(shown["Walk"], None, [3]) for _ in range(2))
    first.reset()
    action = np.full((1, 1), 0.5, np.float32)
    for _ in range(70):  # into the second episode
        first.step(action)
    saved = first.save(0)
    assert second.restore(0, Snapshot(saved.arrays, json.loads(json.dumps(saved.values))))
    for _ in range(40):  # into the third
        ours, theirs = second.step(action), first.step(action)
        assert (ours.next_observation, ours.reward, ours.episodes) == (
            theirs.next_observation,
            theirs.reward,
            theirs.episodes,
        )


# A disk that is full, a directory that is gone. The run is small; evaluation at 100, 200, ...

SMALL: dict[str, Any] = {
    "actor_hidden_sizes": (8, 8),
    "critic_hidden_sizes": (8, 8),
    "batch_size": 8,
    "warmup_steps": 40,
    "replay_size": 150,
}
TRAIN = [
    *("train", "Hopper-v4", "--actor-hidden-sizes", "8", "8", "--critic-hidden-sizes", "8", "8"),
    *("--batch-size", "8", "--warmup-steps", "40", "--replay-size", "150", "--steps", "400"),
    *("--evaluation-interval", "100", "--evaluation-episodes", "1", "--checkpoint-interval", "100"),
    *("--evaluation-processes", "0"),
]
SHORT: dict[str, Any] = {"steps": 400, "evaluation_interval": 100, "evaluation_episodes": 1, "checkpoint_interval": 100}
LONGER: dict[str, Any] = {**SHORT, "steps": 500}


def tables(run: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted([*run.glob("*.csv"), *run.glob("policy/*")])}


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "run"
    assert cli.main([*TRAIN, "--directory", str(path)]) == 0
    return tables(path)


@contextmanager
def no_file_larger_than(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def check_one_clear_line(capsys, run: Path, reason: str) -> None:
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith(f"csac: {run} cannot be written: {reason}; the run can go on from its last checkpoint")


def test_a_file_that_may_not_grow_ends_the_run_and_it_goes_on_later(tmp_path, uninterrupted, capsys):
    """The system's own limit, met by the first checkpoint, which is larger than every file before it."""
    path = tmp_path / "run"
    with no_file_larger_than(12_000):
        assert cli.main([*TRAIN, "--directory", str(path)]) == 1
    check_one_clear_line(capsys, path, "File too large")
    assert cli.main(["resume", str(path)]) == 0
    assert tables(path) == uninterrupted


@pytest.mark.parametrize(
    ("full", "begin"), [("step_200.seed_0.safetensors", 100), ("step_200.episodes.csv", 100), ("step_300.json", 200)]
)
def test_a_full_disk_ends_the_run_and_it_goes_on_later(tmp_path, uninterrupted, monkeypatch, capsys, full, begin):
    path = tmp_path / "run"

    def fsync(descriptor: int) -> None:
        name = Path(os.readlink(f"/proc/self/fd/{descriptor}")).name
        if full in name:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", fsync)
        assert cli.main([*TRAIN, "--directory", str(path)]) == 1
    check_one_clear_line(capsys, path, "No space left on device")
    assert max(steps_in(path / "checkpoint")) == begin
    assert not [name for name in path.rglob(".*") if name.name != ".lock"]
    assert resume(path).manifest.history[0].step == begin
    assert tables(path) == uninterrupted


def test_a_run_that_is_removed_ends_and_stays_removed(tmp_path, capsys):
    path = tmp_path / "run"

    class Removing:
        def __getattr__(self, name: str):
            return self.evaluated if name == "evaluated" else lambda *_: None

        def evaluated(self, step: int, _: Any) -> None:
            shutil.rmtree(path)

    with pytest.raises(RuntimeError, match="cannot be written: No such file or directory"):
        train(CSAC(**SMALL), "Hopper-v4", directory=path, reporter=Removing(), **SHORT)  # pyright: ignore
    assert not path.exists()


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_full_disk_keeps_nobody_waiting_for_tensorboard(tmp_path):
    log = TensorBoardLog(tmp_path, [0])
    row = {"seed": 0, "step": 1, "return": 1.0, "length": 5}
    with no_file_larger_than(10_000), pytest.raises(OSError, match="File too large"):
        consume(log.write({"episodes": [row]}) for _ in range(2000))
    with no_file_larger_than(10_000):
        log.close()


def consume(items: Iterable[Any]) -> None:
    for _ in items:
        pass


@pytest.mark.skipif(os.name != "posix", reason="POSIX permissions")
def test_a_run_that_cannot_be_written_is_refused(tmp_path, monkeypatch):
    run = RunDirectory.create(tmp_path / "run", Manifest(task="t", algorithm="a", seeds=(0,), steps=1))

    def read_only(*_: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr("builtins.open", read_only)
    with (
        pytest.raises(InputError, match=r"cannot write to .*run: Read-only file system"),
        run.locked(),
    ):
        pass


# Kills at the very beginning.


def test_a_run_killed_while_it_was_created_can_be_created(tmp_path):
    """Its manifest has its name once it is whole: before, there are only hidden files."""
    for left_over in (".manifest.json.4711.new", "..manifest.json.4711.new.4711"):
        (tmp_path / left_over).write_bytes(b"{")
    RunDirectory.create(tmp_path, Manifest(task="t", algorithm="a", seeds=(0,), steps=1))


def test_a_manifest_is_never_seen_empty(tmp_path, monkeypatch):
    def killed(*_: Any) -> None:
        assert not (tmp_path / "run" / "manifest.json").exists()
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", killed)
    with pytest.raises(KeyboardInterrupt):
        RunDirectory.create(tmp_path / "run", Manifest(task="t", algorithm="a", seeds=(0,), steps=1))


@pytest.fixture(scope="module")
def short_run(tmp_path_factory):
    return train(CSAC(**SMALL), "Hopper-v4", directory=tmp_path_factory.mktemp("short") / "run", **SHORT).path


@pytest.fixture
def first(short_run, tmp_path):
    """A finished run to fork from or to extend."""
    return RunDirectory.open(shutil.copytree(short_run, tmp_path / "first"))


def test_a_fork_killed_before_it_had_its_checkpoint_copies_once_more(tmp_path, first, monkeypatch):
    """By then its source has made other checkpoints."""

    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    def fork(**options: Any) -> RunDirectory:
        given = {"directory": tmp_path / "fork", "start_from": first.path, **LONGER, **options}
        return train(CSAC(**SMALL), "Hopper-v4", **given)

    with monkeypatch.context() as patched:
        patched.setattr(Checkpoints, "commit", killed)
        with pytest.raises(KeyboardInterrupt):
            fork()
    with pytest.raises(InputError, match="repeat its command, --from included, with --resume"):
        resume(tmp_path / "fork")
    resume(first.path, steps=500)
    with pytest.raises(InputError, match="already holds a run"):
        fork(steps=600)
    again = fork(steps=600, resume=True)
    assert (again.manifest.forked_from, again.manifest.state) == (Origin(str(first.path), 500), "finished")
    resume(first.path, steps=600)
    assert tables(again.path) == tables(first.path)


def test_a_fork_that_wants_no_checkpoints_begins_with_one_all_the_same(tmp_path, first):
    plain: dict[str, Any] = {**LONGER, "checkpoint_interval": 0}
    fork = train(CSAC(**SMALL), "Hopper-v4", directory=tmp_path / "fork", start_from=first.path, **plain)
    resume(first.path, steps=500)
    assert tables(fork.path) == tables(first.path)


def test_a_stranger_s_checkpoint_is_refused_in_one_line(tmp_path, first):
    """Its checksums are right, and what it holds is not what csac saves."""
    place = first.path / "checkpoint"
    for step in steps_in(place):
        files = SeedFiles(place, 0, {}).write(step, Snapshot({"learner.x": np.zeros(2)}, {"learner": []}), ring(4, 0))
        Checkpoints(place, 0).commit(step, files, {})
    with pytest.raises(InputError, match="no such array"):
        train(CSAC(**SMALL), "Hopper-v4", directory=tmp_path / "fork", start_from=first.path, **LONGER)
    with pytest.raises(InputError, match=r"step_400\.json is not what csac writes"):
        resume(first.path, steps=500)


def test_what_a_dead_process_left_unfinished_is_removed_and_nothing_else(tmp_path):
    (tmp_path / "replay").mkdir()
    for name in (
        ".step_3.seed_0.safetensors.77",
        "replay/.seed_0.0-3.safetensors.77",
        ".step_3.json.78",
        "step_3.json",
    ):
        (tmp_path / name).touch()
    remove_unfinished(tmp_path, 77)
    left = sorted(path.name for path in tmp_path.rglob("*") if path.is_file())
    assert left == [".step_3.json.78", "step_3.json"]
