"""Export a policy as one C99 header: `templates/policy.h.jinja` filled with the arrays of its layers."""

from __future__ import annotations

import ctypes
import platform
import re
import shutil
import subprocess
import tempfile
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from csac.deploy.contract import read_file
from csac.deploy.parameters import deterministic, to_tensors
from csac.deploy.templates import render
from csac.types import InputError

if TYPE_CHECKING:
    from csac.deploy.guards import Guards
    from csac.deploy.policy import Policy

BLOCK = 16  # outputs of a layer that are summed in parallel: as many as fit into a Cortex-M4's registers
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")

_WIDTH = 120
_LIBRARY = """\
#define _POSIX_C_SOURCE 200112L
#include <time.h>
#include "policy.h"
static csac_state state = CSAC_INITIAL;
void artefact_reset(void) { csac_reset(&state); }
int64_t artefact_step(const float *observation, float *action)
{
    struct timespec began, ended;
    clock_gettime(CLOCK_MONOTONIC, &began);
    csac_step(&state, observation, action);
    clock_gettime(CLOCK_MONOTONIC, &ended);
    return (int64_t)(ended.tv_sec - began.tv_sec) * 1000000000 + (ended.tv_nsec - began.tv_nsec);
}
"""


def header(policy: Policy, guards: Guards, control_rate: float | None) -> str:
    """Return the C header that runs a policy."""
    contract, (observation_size, action_size) = policy.contract, policy.contract.spec[:2]
    parameters = deterministic(policy.network.parameters, action_size)
    networks = parameters.actors + parameters.critics
    tensors = to_tensors(parameters) | {
        "low": contract.action_low,
        "high": contract.action_high,
        "half": contract.bounds.half,
        "centre": contract.bounds.centre,
    }
    if guards.fallback is not None:
        tensors["fallback"] = guards.fallback
    if guards.largest_change is not None:
        tensors["change"] = guards.largest_change
    return render(
        "policy.h.jinja",
        task=_in_comment(contract.task or "a task of its own"),
        algorithm=_in_comment(contract.algorithm),
        guards=guards,
        observations=observation_size,
        actions=action_size,
        control_rate=None if control_rate is None else _number(control_rate),
        block=BLOCK,
        arrays=[_array(name.replace(".", "_"), array) for name, array in tensors.items()],
        actors=parameters.actors,
        critics=parameters.critics,
        activation=contract.activation,
        critic_activation=contract.critic_activation,
        activations=sorted({contract.activation, *([contract.critic_activation] if parameters.critics else [])}),
        has_layer_norm=any(layer.scale is not None for layers in networks for layer in layers),
        is_clipped=contract.head == "clipped_gaussian",
        has_normaliser=parameters.normaliser is not None,
    )


def _array(name: str, array: np.ndarray) -> str:
    """Return the C definition of a constant array."""
    numbers = _in_blocks(array) if array.ndim == 2 else np.atleast_1d(array)
    lines = textwrap.wrap(" ".join(f"{_number(number)}f," for number in numbers), _WIDTH - 4, break_on_hyphens=False)
    return "\n    ".join([f"static const float csac_{name}[{len(numbers)}] = {{", *lines]) + "\n};"


def _in_blocks(weight: np.ndarray) -> np.ndarray:
    """Return weights [in, out] in the order in which csac_layer reads them."""
    whole = weight.shape[1] - weight.shape[1] % BLOCK
    blocks = [weight[:, first : first + BLOCK].reshape(-1) for first in range(0, whole, BLOCK)]
    return np.concatenate([*blocks, weight[:, whole:].T.reshape(-1)])


def _number(number: float) -> str:
    """Return a float32 number as text that C reads back exactly."""
    text = f"{number:.9g}"
    return text if "." in text or "e" in text else text + ".0"


def _in_comment(text: str) -> str:
    """Return `text` without characters that could end a C comment: the contract may be untrusted."""
    return re.sub(r"[^\w.:/ -]", "_", text)


def compile_c(*arguments: str | Path) -> None:
    """Run the C compiler. Raises InputError if it is not found, or with its first error message."""
    if shutil.which("cc") is None:
        raise InputError("an artefact in C needs a C compiler, and cc is not found: install gcc or clang")
    result = subprocess.run(["cc", *map(str, arguments)], capture_output=True, text=True)
    if result.returncode:
        complaint = next((line for line in result.stderr.splitlines() if "error" in line), result.stderr)
        raise InputError(f"cc does not compile the policy: {' '.join(complaint.split())}")


class Library:
    """Run a header, compiled into a shared library."""

    def __init__(self, path: Path, policy: Policy, guards: Guards, control_rate: float | None, optimise: bool) -> None:
        text = header(policy, guards, control_rate)
        if read_file(path) != text.encode():
            raise InputError(f"{path} is not the header of this csac, which compiles no other code: export it again")
        # Not in the artefact's folder: a foreign math.h there would be included instead of the system's.
        with tempfile.TemporaryDirectory(prefix="csac-") as name:
            source, library = Path(name, "artefact.c"), Path(name, "artefact.so")
            Path(name, "policy.h").write_text(text)
            source.write_text(_LIBRARY)
            # On Arm it gains nothing, and older versions of clang refuse it.
            native = ("-march=native",) if optimise and platform.machine() == "x86_64" else ()
            compile_c(*STRICT, "-fPIC", "-shared", "-O3", *native, source, "-o", library, "-lm")
            self._library = ctypes.CDLL(str(library))  # stays loaded when its file is deleted
        self._step = self._library.artefact_step
        self._step.restype = ctypes.c_int64
        self._action_size = policy.contract.spec.action_size

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the action for an observation."""
        action = np.empty(self._action_size, np.float32)
        self._step(ctypes.c_void_p(observation.ctypes.data), ctypes.c_void_p(action.ctypes.data))
        return action

    def time(self, observation: np.ndarray) -> int:
        """Return the duration of a step in nanoseconds, by a clock read inside the library."""
        action = np.empty(self._action_size, np.float32)
        return self._step(ctypes.c_void_p(observation.ctypes.data), ctypes.c_void_p(action.ctypes.data))

    def reset(self) -> None:
        """Forget the previous action."""
        self._library.artefact_reset()
