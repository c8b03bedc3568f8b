"""A policy that has left its run, in any format: opened, checked, and run as whoever has it will run it."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from csac.checks import check_path
from csac.deploy.artefact_contract import CONTRACT, POLICY_FILES, ArtefactContract
from csac.deploy.c_source import is_header
from csac.deploy.contract import read_file
from csac.deploy.onnx_graph import graph_sizes
from csac.deploy.policy import Policy, noise_generator
from csac.deploy.templates import LOADER
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from csac.deploy.artefact_contract import Format

C_STANDARD = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror")

_ENTRIES = """\
#include "policy.h"
static csac_state state = CSAC_INITIAL;
void artefact_reset(void) { csac_reset(&state); }
void artefact_step(const float *observation, float *action) { csac_step(&state, observation, action); }
"""
_NOISY_ENTRY = """\
void artefact_sample(const float *observation, const float *noise, float *action)
{{
    csac_sample(observation, noise, action);
    {guard}
}}
"""


class Artefact:
    """A policy in a folder of its own. Made by `open_artefact`."""

    def __init__(self, folder: Path, contract: ArtefactContract, runner: Runner) -> None:
        self.folder, self.contract = folder, contract
        self._runner, self._size = runner, contract.policy.spec.observation_size

    @property
    def format(self) -> Format:
        """Its format: numpy, onnx or c."""
        return self.contract.format

    def act(self, observation: np.ndarray, noise: np.ndarray | None = None) -> np.ndarray:
        """Return the action, float32 [action], on the environment's scale: with guards, and sampled where exported so.

        Args:
            observation: raw and flat, float32 [observation], in the order of the contract.
            noise: standard normal, float32 [action], of a policy that samples; it draws its own where not given.

        Raises:
            InputError: an observation or noise of another shape, or noise for a policy that does not sample.
        """
        observation = np.ascontiguousarray(observation, np.float32)
        if observation.shape != (self._size,):
            raise InputError(f"the observation has shape {observation.shape}; the artefact takes ({self._size},)")
        return self._runner.act(observation, None if noise is None else self._checked(noise))

    def _checked(self, noise: np.ndarray) -> np.ndarray:
        """Return noise as every runner can take it: one in C reads as many numbers as there are actions."""
        if self.contract.noise_seed is None:
            raise InputError("the artefact was exported without --stochastic: it takes no noise")
        noise, size = np.ascontiguousarray(noise, np.float32), self.contract.policy.spec.action_size
        if noise.shape != (size,):
            raise InputError(f"the noise has shape {noise.shape}; the artefact takes ({size},)")
        return noise

    def reset(self) -> None:
        """Have the guards forget what was before: an episode begins."""
        self._runner.reset()

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return the action for what the environment gave, [*action_shape], and `state` as it came.

        In Stable-Baselines3's shape, for one observation. Whether it is sampled was decided at the export.
        """
        if episode_start is not None and np.any(episode_start):
            self.reset()
        action = self.act(self.contract.policy.flatten(observation))
        return action.reshape(self.contract.policy.action_shape), state


class Runner(Protocol):
    """What runs an artefact of one format."""

    def act(self, observation: np.ndarray, noise: np.ndarray | None) -> np.ndarray:
        """Return the action [action] for an observation, float32 [observation]."""
        ...

    def reset(self) -> None:
        """Forget what was before."""
        ...


def open_artefact(path: str | Path) -> Artefact:
    """Open an artefact, given its folder or the policy's file in it.

    No code is run but csac's own: a loader, or a header in C, that differs from what this csac writes is refused.

    Raises:
        InputError: no artefact there, a damaged or a foreign one, or nothing here to run it with.
    """
    check_path("the folder of an artefact", path)
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path} does not exist; give the folder of an artefact (csac export writes one)")
    folder = path if path.is_dir() else path.parent
    contract = ArtefactContract.load(folder)
    if not path.is_dir() and path.name not in (contract.file, CONTRACT, LOADER.name):
        raise InputError(f"{path} is not the artefact in its folder: that is {contract.file}")
    runners = {"numpy": _NumPy, "onnx": _ONNX, "c": _C}
    return Artefact(folder, contract, runners[contract.format](folder, contract))


def compiler(name: str = "cc") -> str:
    """Return the path of a C compiler. Raises InputError where it is not there."""
    path = shutil.which(name)
    if path is None:
        raise InputError(f"an artefact in C needs a C compiler, and {name} is not found here: install gcc or clang")
    return path


def compile_c(*arguments: str | Path, program: str = "cc") -> None:
    """Run a C compiler. Raises InputError with what it complains of first."""
    result = subprocess.run([compiler(program), *map(str, arguments)], capture_output=True, text=True)
    if result.returncode:
        complaint = next((line for line in result.stderr.splitlines() if "error" in line), result.stderr)
        raise InputError(f"{program} does not compile {_blamed(complaint, arguments)}: {' '.join(complaint.split())}")


def _blamed(complaint: str, arguments: Sequence[str | Path]) -> str:
    """Return the name of the file that a compiler complains of, or else of the source that it was given."""
    files = (complaint.partition(":")[0], *map(str, arguments))
    return next((Path(file).name for file in files if file.endswith((".c", ".h"))), "what it was given")


@contextmanager
def header_alone(folder: Path, contract: ArtefactContract) -> Iterator[Path]:
    """Yield a new folder to compile in, which holds the header of an artefact as it was read and looked at.

    Of the artefact's own folder a compiler sees nothing: a `math.h` in it would be taken for the system's.

    Raises:
        InputError: the header cannot be read, or is not csac's own.
    """
    path = folder / contract.file
    text = read_file(path).decode(errors="replace")
    if not is_header(text, contract):
        raise InputError(f"{path} is not a header of this csac, which compiles no other code: export it again")
    with tempfile.TemporaryDirectory(prefix="csac-") as name:
        Path(name, POLICY_FILES["c"]).write_bytes(text.encode())
        yield Path(name)


class _NumPy:
    """Runs the loader that lies in the folder, after a look that it is csac's own and that the policy is one."""

    def __init__(self, folder: Path, contract: ArtefactContract) -> None:
        path = folder / LOADER.name
        content = read_file(path)
        if content != LOADER.read_bytes():
            raise InputError(f"{path} is not the loader of this csac, which runs no other code: export it again")
        Policy.load(folder / contract.file, contract.policy)  # reads strictly what the loader takes for granted
        module = ModuleType("csac_exported_policy")
        module.__file__ = str(path)
        exec(compile(content, path, "exec"), vars(module))
        try:
            self._policy = vars(module)["Policy"](folder)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{folder} is damaged ({error!r:.100}): export it again") from error
        self.act, self.reset = self._policy.act, self._policy.reset


class _ONNX:
    """Runs the graph by ONNX Runtime, in one thread: a controller shares its processor."""

    def __init__(self, folder: Path, contract: ArtefactContract) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise InputError("an ONNX artefact needs ONNX Runtime: pip install '.[onnx]' in a clone of csac") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        path = folder / contract.file
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # its own kinds, which have no common name
            raise InputError(f"ONNX Runtime does not take {path}: {' '.join(str(error).split())}") from error
        self._action_size = contract.policy.spec.action_size
        self._has_state = contract.guards.has_state
        self._generator = None if contract.noise_seed is None else noise_generator(contract.noise_seed)
        self._inputs: dict[str, np.ndarray] = {}
        inputs, outputs = graph_sizes(contract)
        self._outputs = list(outputs)
        self._try(path, inputs, outputs)
        self.reset()

    def _try(self, path: Path, inputs: dict[str, int], outputs: dict[str, int]) -> None:
        """Run it once on zeros. Raises InputError where its inputs or outputs are not what the contract says."""
        try:
            given: Any = self._session.run(
                self._outputs, {name: np.zeros((1, size), np.float32) for name, size in inputs.items()}
            )
        except Exception as error:  # its own kinds
            reason = " ".join(str(error).split())
            raise InputError(f"{path} is not the graph of its {CONTRACT} ({reason}): export it again") from error
        found = [(np.shape(array), np.asarray(array).dtype) for array in given]
        if found != [((1, size), np.float32) for size in outputs.values()]:
            raise InputError(f"{path} is not the graph of its {CONTRACT} (it gives {found}): export it again")

    def act(self, observation: np.ndarray, noise: np.ndarray | None) -> np.ndarray:
        self._inputs["observation"] = observation[None]
        if self._generator:
            drawn = self._generator.standard_normal(self._action_size, np.float32) if noise is None else noise
            self._inputs["noise"] = drawn[None]
        outputs: Any = self._session.run(self._outputs, self._inputs)
        if self._has_state:
            self._inputs["state"] = outputs[1]
        return outputs[0][0]

    def reset(self) -> None:
        if self._has_state:
            self._inputs["state"] = np.zeros((1, self._action_size + 2), np.float32)


class _C:
    """Runs the header, compiled into a shared library of its own."""

    def __init__(self, folder: Path, contract: ArtefactContract) -> None:
        compiler()
        guard = "csac_guard(&state, observation, action);" if contract.guards.is_any else ""
        noisy_entry = _NOISY_ENTRY.format(guard=guard) if contract.noise_seed is not None else ""
        with header_alone(folder, contract) as place:
            source, library = place / "artefact.c", place / "artefact.so"
            source.write_text(_ENTRIES + noisy_entry)
            compile_c(*C_STANDARD, "-fPIC", "-shared", "-O3", source, "-o", library, "-lm")
            self._library = ctypes.CDLL(str(library))  # stays in memory without its file
        self._action_size = contract.policy.spec.action_size
        self._step, self._reset = self._library.artefact_step, self._library.artefact_reset
        self._sample = getattr(self._library, "artefact_sample", None)
        for function in (self._step, self._reset, self._sample):
            if function:
                function.restype = None

    def act(self, observation: np.ndarray, noise: np.ndarray | None) -> np.ndarray:
        action = np.empty(self._action_size, np.float32)
        if noise is None or not self._sample:
            self._step(_pointer(observation), _pointer(action))
        else:
            self._sample(_pointer(observation), _pointer(np.ascontiguousarray(noise, np.float32)), _pointer(action))
        return action

    def reset(self) -> None:
        self._reset()


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
