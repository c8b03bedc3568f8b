"""A process that runs one cell on cores of its own. Nothing heavy is imported before: XLA counts its cores once."""

from __future__ import annotations

import pickle
import signal
from typing import TYPE_CHECKING

from csac.processes import die_with_parent, move_to

if TYPE_CHECKING:
    from collections.abc import Sequence
    from multiprocessing.connection import Connection


def work(connection: Connection, cores: Sequence[int], packed: bytes) -> None:
    """Run the job in `packed` and send what happens. SIGTERM saves what was learnt; a Ctrl-C is left to the parent."""
    die_with_parent()
    move_to(cores)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    from csac.studies.job import Ended, Stopped, execute

    job = pickle.loads(packed)
    try:
        connection.send(execute(job, connection.send))
    except Stopped:
        connection.send(Ended(job.cell.key, "stopped"))
