"""PyBullet kept quiet. It prints from C, at import and whenever it connects, where Python's streams do not see it.

PyFlyt prints from Python, and Python's streams need not end in the descriptors: in a notebook they do not.
"""

from __future__ import annotations

import ctypes
import io
import logging
import os
import re
import sys
import tempfile
import threading
from contextlib import contextmanager, suppress
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

# What PyBullet prints, the second half with a window alone, and with what PyFlyt's Aviary clears it from a terminal. It
# need not begin a line: what a display has left may stand before it.
_CHATTER = re.compile(
    rb"(?:pybullet build time: [^\n]*|arg[cv](?:\[\d+\])? ?=[^\n]*|\x1b\[A *\x1b\[A|b3(?:Printf|Warning|Error)[^\n]*"
    rb"|startThreads creating [^\n]*|start(?:ed|ing) thread \d+[^\n]*|numActiveThreads = \d+|stopping threads"
    rb"|GL_[A-Z_]+=[^\n]*|MotionThreadFunc: [^\n]*|Thread with taskId [^\n]*|Thread TERMINATED)\r?\n"
)

_lock = threading.RLock()  # the descriptors belong to the whole process
_log = logging.getLogger(__name__)


@contextmanager
def quietly() -> Iterator[None]:
    """Keep what PyBullet prints in this block from standard output and error; it goes to the log, at level DEBUG.

    Whatever else is written meanwhile, by this thread or another, comes out at the end of the block.
    """
    with _lock, _kept(1, sys.stdout), _kept(2, sys.stderr), _printed("stdout"), _printed("stderr"):
        yield


@contextmanager
def _kept(descriptor: int, stream: object) -> Iterator[None]:
    """Let a descriptor point to a file during this block, and pass on what is not chatter."""
    _flush(stream)
    try:
        file = _file()
    except OSError:  # no place for one: rather noise than a task that cannot be made
        yield
        return
    with file:
        try:
            original = os.dup(descriptor)
        except OSError:  # closed: nobody can be disturbed
            yield
            return
        os.dup2(file.fileno(), descriptor)
        try:
            yield
        finally:
            _flush(stream)
            os.dup2(original, descriptor)
            os.close(original)
            file.seek(0)
            _pass_on(descriptor, file.read())


@contextmanager
def _printed(name: str) -> Iterator[None]:
    """Let Python's stream of this name be another during this block, and pass on what is not chatter."""
    stream, aside = getattr(sys, name), io.StringIO()
    setattr(sys, name, aside)
    try:
        yield
    finally:
        if getattr(sys, name) is aside:
            setattr(sys, name, stream)
        rest = _without_chatter(aside.getvalue().encode(errors="surrogatepass"))
        with suppress(OSError, ValueError, AttributeError):  # nobody reads any more, or there is no stream
            stream.write(rest.decode(errors="surrogatepass"))


def _file() -> IO[bytes]:
    """Return a file without a name, in memory where there is such a thing."""
    return os.fdopen(os.memfd_create("quietly"), "w+b") if hasattr(os, "memfd_create") else tempfile.TemporaryFile()


def _pass_on(descriptor: int, written: bytes) -> None:
    rest = _without_chatter(written)
    with suppress(OSError):  # nobody reads any more
        while rest:
            rest = rest[os.write(descriptor, rest) :]


def _without_chatter(written: bytes) -> bytes:
    if chatter := _CHATTER.findall(written):
        _log.debug("PyBullet: %s", b"".join(chatter).decode(errors="replace").strip())
    return _CHATTER.sub(b"", written)


def _flush(stream: object) -> None:
    """Write what Python's stream and C's hold back."""
    with suppress(OSError, ValueError, AttributeError):
        stream.flush()  # pyright: ignore[reportAttributeAccessIssue]
    if os.name == "posix":
        ctypes.CDLL(None).fflush(None)
