"""Before anything imports JAX: small processes, and a broadcast that raises the rank is an error."""

import os
import tempfile

os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"
os.environ["JAX_PLATFORMS"] = "cpu"
for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[threads] = "1"

# Compiled programs, and which modules may be imported, are kept for the length of the tests, not among the user's own.
_KEPT = tempfile.TemporaryDirectory()
os.environ["XDG_CACHE_HOME"] = os.environ["XDG_STATE_HOME"] = _KEPT.name
