"""Before anything imports JAX: small processes, and a broadcast that raises the rank is an error."""

import os
import signal
import tempfile

import hypothesis
import pytest

os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"
os.environ["JAX_PLATFORMS"] = "cpu"
# XLA optimises little: two thirds of the time would be compilation of programs that run but for moments. What depends
# on the last bits has processes of its own, without the flags.
_QUICK = "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_QUICK}".strip()
os.environ["NUMBA_DISABLE_JIT"] = "1"  # PyFlyt's few functions take 8 s to compile, and a moment in Python
for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[threads] = "1"

# Which modules may be imported, and compiled programs, are kept for the length of the tests, not among the user's own.
# The programs are for all processes of the tests: XLA would take two thirds of their time.
_KEPT = tempfile.TemporaryDirectory()
os.environ["XDG_STATE_HOME"] = _KEPT.name
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["XDG_CACHE_HOME"] = _KEPT.name

# A shell has its background jobs ignore Ctrl-C, and what they start inherits that.
signal.signal(signal.SIGINT, signal.default_int_handler)


# How long an example takes says how busy the machine is.
hypothesis.settings.register_profile("untimed", deadline=None)
hypothesis.settings.load_profile("untimed")


LONGEST = ("training", "tasks", "test_results.py", "test_cli.py")  # folders and files


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put what takes longest first: else one process is left with it alone at the end."""

    def place(item: pytest.Item) -> int:
        names = item.path.parent.name, item.path.name
        return next((place for place, name in enumerate(LONGEST) if name in names), len(LONGEST))

    items.sort(key=place)
