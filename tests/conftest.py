"""Before anything imports JAX: small processes, and a broadcast that raises the rank is an error."""

import os
import tempfile

os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"
os.environ["JAX_PLATFORMS"] = "cpu"
for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[threads] = "1"

# Which modules may be imported, and compiled programs, are kept for the length of the tests, not among the user's own.
# The programs are for all processes of the tests: XLA would take two thirds of their time.
_KEPT = tempfile.TemporaryDirectory()
os.environ["XDG_STATE_HOME"] = _KEPT.name
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ["XDG_CACHE_HOME"] = _KEPT.name
