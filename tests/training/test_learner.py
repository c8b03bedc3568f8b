"""What a learner keeps and under which names."""

from __future__ import annotations

import re
import weakref
from typing import Any

import jax
import numpy as np
import pytest
import safetensors.numpy

from csac.algorithms import ALGORITHMS, CSAC, SAC, TD3
from csac.algorithms.memory import row_width
from csac.tasks.vector import Steps
from csac.training.checkpoint import SCHEMA_VERSION, Checkpoint, Damaged, Writer
from csac.training.learner import Learner, incompatibility
from csac.training.packing import by_name
from csac.types import Snapshot, Spec

SPEC = Spec(3, 1)
TINY: dict[str, Any] = {"actor_hidden_sizes": (4,), "critic_hidden_sizes": (4,), "batch_size": 8, "warmup_steps": 2}


def advance(learner: Learner, seeds: int, first: int, last: int) -> np.ndarray:
    """Give a learner the steps from `first` to `last`, of which no two are equal, and return its last actions."""
    generator, none = np.random.default_rng(first), np.zeros(seeds, bool)
    actions = np.zeros((seeds, SPEC.action_size), np.float32)
    for step in range(first, last + 1):
        before, after = generator.normal(size=(2, seeds, SPEC.observation_size)).astype(np.float32)
        outcome = Steps(after, np.full(seeds, step, np.float32), none, none, after, [], [])
        actions = learner.step(before, actions, outcome, step)
    return actions


def test_a_checkpoint_names_its_arrays_by_where_they_are_in_the_state(tmp_path):
    learner = Learner(TD3(**TINY), SPEC, [0], 100)
    ring = learner.memory(0, 0)
    Writer(tmp_path, {}).write(0, learner.save(0), ring, {})
    arrays = safetensors.numpy.load((tmp_path / "step_0" / "state.safetensors").read_bytes())

    networks = ["actor", "target_actor", "critics.0", "critics.1", "target_critics.0", "target_critics.1"]
    parts = [f"layers.{layer}.{part}" for layer in (0, 1) for part in ("weight", "bias")]
    of_networks = {f"state.{network}.{part}" for network in networks for part in parts}
    of_adam = {f"state.actor_optimiser.0.{moment}.{part}" for moment in ("mu", "nu") for part in parts}
    assert of_networks | of_adam | {"state.actor_metrics.actor_loss", "state.actor_optimiser.0.count"} < set(arrays)
    assert set(arrays) - {name for name in arrays if name.startswith("state.")} == {"sums", "key", "waiting"}
    np.testing.assert_array_equal(arrays["state.actor.layers.1.bias"], learner.state(0).actor.layers[1].bias)


def test_a_checkpoint_of_the_schema_before_is_refused_in_one_line(tmp_path, monkeypatch):
    learner = Learner(TD3(**TINY), SPEC, [0], 100)
    with monkeypatch.context() as older:
        older.setattr("csac.training.checkpoint.SCHEMA_VERSION", SCHEMA_VERSION - 1)
        Writer(tmp_path, {}).write(5, learner.save(0), learner.memory(0, 0), {})
    with pytest.raises(Damaged, match=f"schema {SCHEMA_VERSION - 1}"):
        Checkpoint.open(tmp_path, 5)


def test_the_memory_that_a_learner_begins_with_is_gone_before_the_saved_one_is_read():
    """A replay may take half of a machine's memory: three at a time took a run along that had been trained there."""
    learner = Learner(SAC(**TINY), SPEC, [0], 100)
    saved, begun = learner.save(0), weakref.ref(learner._carry.memory.rows)
    there = []
    learner.restore([saved], [lambda rows: there.append(begun())])
    assert there == [None]


def state_of(algorithm: CSAC) -> Snapshot:
    """What would be saved of it, of zeros."""
    state = jax.eval_shape(lambda: algorithm.init(jax.random.key(0), SPEC, 100))
    arrays = {name: np.zeros(leaf.shape, leaf.dtype) for name, leaf in by_name({"state": state}).items()}
    return Snapshot({**arrays, "waiting": np.zeros((1, row_width(SPEC)), np.float32)}, {})


@pytest.mark.parametrize(
    ("before", "after", "problem"),
    [
        ({"entropy_weight": "auto"}, {}, None),
        ({}, {"entropy_weight": "auto"}, "state.temperature"),
        ({"policy_delay": 2}, {}, None),
        ({}, {"policy_delay": 2}, "state.actor_metrics"),
    ],
)
def test_what_a_checkpoint_has_fits_or_is_refused(before, after, problem):
    found = incompatibility(CSAC(**TINY, **after), SPEC, 100, state_of(CSAC(**TINY, **before)))
    assert found is None if problem is None else problem in found


def test_means_begin_anew_where_other_things_are_told():
    before: dict[str, Any] = {"entropy_weight": "auto"}
    after: dict[str, Any] = {}
    learner, again = (Learner(CSAC(**TINY, **changes), SPEC, [0], 100) for changes in (before, after))
    advance(learner, 1, 1, 6)
    rows = learner.memory(0, 6).rows.copy()
    again.restore([learner.save(0)], [lambda given: np.copyto(given, rows)])
    assert again.metrics() == []
    advance(again, 1, 7, 7)
    alone = Learner(CSAC(**TINY, **after), SPEC, [0], 100)
    advance(alone, 1, 1, 4)
    assert again.metrics()[0].keys() == alone.metrics()[0].keys()


SETTINGS = [(name, {}) for name in ALGORITHMS] + [("csac", {"reference_policy": "periodic", "reference_period": 1})]


@pytest.mark.parametrize(("name", "changes"), SETTINGS, ids=str)
def test_what_a_seed_carries_is_updated_in_the_buffer_where_it_lies(name, changes):
    # An argument that JAX drops would shift all that follow: a period of 1 never reads the reference that it keeps.
    learner = Learner(ALGORITHMS[name](**changes), SPEC, [0], 5_000)
    given = jax.eval_shape(lambda: (learner._carry, learner._parcel.pack(1, learner._waiting[0], np.zeros(3))))
    program = learner._learn.lower(*given).as_text()
    (signature,) = re.findall(r"func.func public @main\((.*)\) ->", program)
    outputs = [int(place) for place in re.findall(r"tf.aliasing_output = (\d+)", signature)]
    assert outputs == list(range(len(jax.tree.leaves(learner._carry))))


@pytest.mark.parametrize("interval", [1, 3])
def test_nothing_that_a_program_was_given_is_written_over(monkeypatch, interval):
    """JAX does not copy NumPy's arrays where they are aligned, and may still read them when a dispatch returns."""
    learner = Learner(TD3(**TINY, update_interval=interval), SPEC, [0], 100)
    given: list[tuple[np.ndarray, np.ndarray]] = []
    for name in ("_explore", "_learn"):
        own = getattr(learner, name)

        def program(carry, *arguments, own=own):
            given.extend((array, np.array(array)) for array in arguments)
            return own(carry, *arguments)

        monkeypatch.setattr(learner, name, program)
    advance(learner, 1, 1, 12)
    assert len(given) == 12 // interval
    for array, then in given:
        np.testing.assert_array_equal(array, then)


@pytest.mark.parametrize("seeds", [1, 2])
def test_an_algorithm_is_traced_once(monkeypatch, seeds):
    """Its shapes are asked for before it runs; tracing takes a good part of the start."""
    traced = []
    for name in ("init", "update"):
        own = getattr(CSAC, name)
        monkeypatch.setattr(CSAC, name, lambda *given, name=name, own=own: traced.append(name) or own(*given))
    advance(Learner(CSAC(**TINY), SPEC, range(seeds), 100), seeds, 1, 4)
    assert sorted(traced) == ["init", "update"]
