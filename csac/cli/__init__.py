"""Entry point of the `csac` command: dispatch to the sub-commands and turn errors into exit codes."""

from __future__ import annotations

import faulthandler
import io
import os
import sys
import warnings
from contextlib import suppress
from typing import TYPE_CHECKING

from csac.cli.exits import complain, interrupted
from csac.types import Failure, InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

HELP = """\
usage: csac COMMAND ...

Train controllers for continuous-control tasks with Conservative Soft Actor-Critic.

  csac train TASK      train controllers for a Gymnasium task, several seeds at once
  csac resume DIR      resume runs that were stopped or killed
  csac evaluate DIR    test the policies of runs on fresh episodes
  csac play DIR        watch a policy, or record a video
  csac export DIR      export a policy as NumPy, ONNX or C, and verify it
  csac latency PATH    measure how long an exported policy takes per action
  csac runs [DIR]      list the runs below a directory
  csac report DIR...   compare runs: a page of curves, tables and commands
  csac study COMMAND   run the paper's experiments, or your own
  csac tune TASK       search for good hyperparameters

  csac COMMAND --help  explain a command and its options
  csac --version       print the version

To begin: csac train HalfCheetah-v4 --seeds 2 --steps 60_000
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `csac` with `arguments`, by default those of `sys.argv`, and return the exit code.

    0: done. 1: the environment or the disk failed (internal errors are raised). 2: wrong arguments or input.
    3: finished, but a seed failed. 130: SIGINT. 143: SIGTERM.
    """
    _prepare_streams()
    if arguments is None:
        faulthandler.enable()  # a simulator's native code may crash this process
    warnings.formatwarning = lambda message, *_, **__: f"csac: warning: {message}\n"
    try:
        code = _dispatch(list(sys.argv[1:] if arguments is None else arguments))
    except (InputError, Failure) as error:
        code = complain(error, 2 if isinstance(error, InputError) else 1)
    except KeyboardInterrupt as error:
        code = interrupted(error)
    return _flush() or code


def _dispatch(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        with suppress(BrokenPipeError):
            print(HELP.rstrip())
        return 0
    if words[0] in ("--version", "-V"):
        from csac import __version__

        print(f"csac {__version__}")
        return 0
    from csac.cli.commands import run  # imports tyro and NumPy

    return run(words[0], words[1:])


def _prepare_streams() -> None:
    """Open closed standard streams on /dev/null: the next opened file would receive what libraries print to them."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


def _flush() -> int:
    """Flush stdout and return the exit code; a pipe that its reader closed (`csac runs | head`) is no error."""
    try:
        sys.stdout.flush()
        return 0
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        is_pipe = isinstance(error, BrokenPipeError)
        return 0 if is_pipe else complain(f"standard output cannot be written: {error.strerror}", 1)
