"""One episode of a peer's policy, as csac's own evaluation has it: what is learnt is compared on the same starts.

Nothing but the standard library is imported here: a clock that runs from the start of a process waits for every import.
"""

# Episode j of every evaluation is reset with this seed + j: the same starts that csac's own evaluation uses.
EVALUATION_SEED = 1_000_000


def evaluate(model, environment, episodes):
    """Return the return and the length, in environment steps, of each episode of deterministic actions."""
    return [_episode(model, environment, EVALUATION_SEED + episode) for episode in range(episodes)]


def _episode(model, environment, seed):
    """Return the return and the length of one episode; deterministic actions draw no random numbers."""
    observation, _ = environment.reset(seed=seed)
    total, length, ended = 0.0, 0, False
    while not ended:
        action, _ = model.predict(_scaled(model, observation), deterministic=True)
        observation, reward, terminated, truncated, _ = environment.step(action)
        total, length, ended = total + float(reward), length + 1, terminated or truncated
    return total, length


def _scaled(model, observation):
    """Return the observation on the scale that training has reached by now, where the model has such a scale."""
    normaliser = model.get_vec_normalize_env()
    return observation if normaliser is None else normaliser.normalize_obs(observation)
