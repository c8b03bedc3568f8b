"""Read a run's learnt state, critics included, and its replay buffer from Python."""

from __future__ import annotations

import os
import warnings
from typing import Any

import jax
import numpy as np

from csac.algorithms.critics import q_value
from csac.algorithms.memory import row_width, unpack
from csac.algorithms.networks import BATCH
from csac.algorithms.normalisation import normalised_pass
from csac.algorithms.statistics import normalise
from csac.checks import check_whole
from csac.deploy.choosing import choose_run, load_run
from csac.record.config import STEPS_LIMIT
from csac.record.run import RunDirectory
from csac.record.sets import RunSet
from csac.training.checkpoint import Checkpoint, checkpoint_of
from csac.training.config import algorithm_of
from csac.training.learner import incompatibility
from csac.training.one_seed import KEY_DATA
from csac.training.packing import by_name
from csac.types import InputError, Transition

STATISTICS_TRANSITIONS = 4_096  # newest transitions that give batch-normalised critics their statistics


class Learnt:
    """The learnt state of a seed at a checkpoint.

    Attributes:
        run: the run.
        algorithm: the algorithm with its hyperparameters.
        step: environment steps made.
        state: the algorithm's `State`, a tree of NumPy arrays: actor, critics, targets, optimisers.
    """

    def __init__(self, run: RunDirectory, checkpoint: Checkpoint, trust_task: bool = False) -> None:
        self.run, self.step, self._checkpoint = run, checkpoint.step, checkpoint
        self.algorithm = algorithm_of(run.config, run.path, trust_task)
        self._contract = load_run(run).contract
        spec, saved = self._contract.spec._replace(environments=run.config.environments), checkpoint.state()
        learner, steps = saved.part("learner"), run.config.steps
        if problem := incompatibility(self.algorithm, spec, steps, learner):
            raise InputError(f"the checkpoint does not fit: {problem}: use the csac that wrote it")
        shapes = jax.eval_shape(lambda key: self.algorithm.init(key, spec, steps), KEY_DATA)
        leaves = [learner.arrays[f"state.{name}"] for name in by_name(shapes)]
        self.state: Any = jax.tree.unflatten(jax.tree.structure(shapes), leaves)
        self._reward_scale = learner.arrays.get("returns.statistics.std", np.float32(1.0))

    def replay(self) -> dict[str, np.ndarray]:
        """Return the transitions in the replay buffer, oldest first, as arrays.

        `observations` and `next_observations` [n, observation] are flat, `actions` [n, action] on the environment's
        scale, `rewards` [n], `terminated` and `truncated` [n] bool.
        """
        transitions = self._transitions()
        bounds = self._contract.bounds
        return {
            "observations": transitions.observation,
            "actions": bounds.scale(transitions.action),
            "rewards": transitions.reward,
            "next_observations": transitions.next_observation,
            "terminated": transitions.terminated.astype(bool),
            "truncated": transitions.truncated.astype(bool),
        }

    def q_values(self, observations: Any, actions: np.ndarray) -> np.ndarray:
        """Return each critic's Q(s, a), [critic] or for batches [n, critic], on the scale of the task's rewards.

        Observations are as the task gives them, actions on the environment's scale.

        Raises:
            InputError: the algorithm has no critics Q(s, a), or the actions have another size.
        """
        critics, statistics = self._critics()
        flat = np.atleast_2d(self._contract.flatten(observations))
        given, size = np.asarray(actions, np.float32), self._contract.spec.action_size
        if given.size != len(flat) * size:
            raise InputError(
                f"actions has shape {given.shape}: give {size} numbers for each of {len(flat)} observations"
            )
        inner = self._contract.bounds.unscale(given.reshape(len(flat), size))

        def of_one(observation: jax.Array, action: jax.Array) -> list[jax.Array]:
            return [q_value(critic, normalise(statistics, observation), action) for critic in critics]

        values = np.stack(jax.vmap(of_one)(jax.numpy.asarray(flat), jax.numpy.asarray(inner, np.float32)), axis=-1)
        values = values * self._reward_scale
        return values if self._contract.flatten(observations).ndim == 2 else values[0]

    def _critics(self) -> tuple[list[Any], Any]:
        """Return the critics, ready to evaluate, and the statistics that normalise their observations."""
        pairs = [self.state] if hasattr(self.state, "critics") else list(self.state)
        critics = [c for pair in pairs for c in getattr(pair, "critics", [getattr(pair, "critic", None)])]
        if any(critic is None for critic in critics):
            raise InputError(f"{self.run.config.algorithm} has no critics Q(s, a); CSAC, SAC, TD3 and SD3 have")
        statistics = getattr(self.state, "observation_statistics", None)
        if getattr(self.algorithm, "critic_normalisation", "none") == "batch":
            critics = self._folded(critics, statistics)
        return critics, statistics

    def _folded(self, critics: list[Any], statistics: Any) -> list[Any]:
        """Return batch-normalised critics as plain ones, with the statistics of the newest transitions."""
        newest = jax.tree.map(lambda array: array[-STATISTICS_TRANSITIONS:], self._transitions())

        def of_one(critic: Any, one: Transition) -> Any:
            next_action = self.algorithm.act(self.state, one.next_observation, jax.random.key(0), explore=False)
            pairs = [(one.observation, one.action), (one.next_observation, next_action)]
            inputs = [jax.numpy.concatenate([normalise(statistics, seen), action]) for seen, action in pairs]
            return normalised_pass(critic, inputs).folded

        return [jax.vmap(of_one, (None, 0), out_axes=None, axis_name=BATCH)(critic, newest) for critic in critics]

    def _transitions(self) -> Transition:
        """Return the transitions in the replay buffer, [n, ...] each, with actions as the algorithm chose them."""
        first, last = self._checkpoint.transitions
        rows = np.zeros((last - first, row_width(self._contract.spec)), np.float32)
        if len(rows):
            for lost in self._checkpoint.fill(rows):
                warnings.warn(lost, stacklevel=3)
        in_order = jax.numpy.asarray(rows[np.arange(first, last) % max(len(rows), 1)])
        return jax.tree.map(np.asarray, jax.vmap(unpack, (0, None))(in_order, self._contract.spec))


def load_checkpoint(
    directory: str | os.PathLike[str], seed: int | None = None, step: int | None = None, trust_task: bool = False
) -> Learnt:
    """Return the learnt state of a seed at its newest checkpoint, or at the one of a step.

    Args:
        directory: a set of runs, or one run.
        seed: the seed's label; by default the one that `csac.load` chooses.
        step: the step of a checkpoint that was kept (`keep_checkpoints`).
        trust_task: whether to import the module of a user-defined algorithm that nobody has named on this machine.

    Raises:
        InputError: there is no such run, seed or checkpoint.
    """
    run = choose_run(RunSet.open(directory), seed)
    if step is not None:
        check_whole("step", step, 1, STEPS_LIMIT)
    return Learnt(run, checkpoint_of(run.checkpoints, step), trust_task)
