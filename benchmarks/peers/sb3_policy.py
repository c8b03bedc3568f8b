"""How long SB3's SAC takes for an action, by `predict` and by the ONNX recipe of its documentation.

`python -m benchmarks latency` runs it with the peers' Python. The recipe's graph leaves out the rescaling of actions,
which this script adds: a controller needs it.
"""

import argparse
import gc
import json
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from stable_baselines3 import SAC

WARM_UP = 1_000


class OnnxablePolicy(torch.nn.Module):
    """The actor with its squashing, as the documentation wraps it."""

    def __init__(self, actor):
        super().__init__()
        self.actor = actor

    def forward(self, observation):
        """Return actions in [-1, 1] for observations [n, observation]."""
        return self.actor(observation, deterministic=True)


def by_onnx(model):
    """Return what gives an action for an observation, by ONNX Runtime in one thread."""
    import onnxruntime

    with tempfile.TemporaryDirectory() as folder:
        path = str(Path(folder, "policy.onnx"))
        example = torch.randn(1, *model.observation_space.shape)
        wrapped = OnnxablePolicy(model.policy.actor)
        torch.onnx.export(wrapped, example, path, opset_version=17, input_names=["input"], dynamo=False)
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    unscale = model.policy.unscale_action

    def act(observation):
        return unscale(session.run(None, {"input": observation[None]})[0])[0]

    return act


def latency(act, calls):
    """Return percentiles of single calls in microseconds, one after the other, with the garbage collector off."""
    observations = list(np.random.default_rng(0).standard_normal((1024, 17)).astype(np.float32))
    for call in range(WARM_UP):
        act(observations[call % 1024])
    durations = np.zeros(calls, np.int64)
    gc.disable()
    for call in range(calls):
        began = time.perf_counter_ns()
        act(observations[call % 1024])
        durations[call] = time.perf_counter_ns() - began
    percentiles = np.percentile(durations, [50, 99, 99.9, 100], method="higher") / 1e3
    return dict(zip(("p50", "p99", "p99.9", "max"), percentiles.tolist(), strict=True))


def main():
    """Measure, and print a line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--way", choices=("predict", "onnx"), required=True)
    parser.add_argument("--count", type=int, default=10, help="calls")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = SAC("MlpPolicy", "HalfCheetah-v4", seed=0, device="cpu", buffer_size=1)
    if arguments.way == "onnx":
        found = latency(by_onnx(model), arguments.count)
    else:
        found = latency(lambda observation: model.predict(observation, deterministic=True)[0], arguments.count)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
