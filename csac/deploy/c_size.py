"""How much code, data and stack a C artefact takes, as the compilers that are here say."""

from __future__ import annotations

import shutil
import subprocess
from typing import TYPE_CHECKING, NamedTuple

from csac.deploy.artefact import C_STANDARD, compile_c, header_alone
from csac.deploy.artefact_contract import ArtefactContract
from csac.types import InputError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

TARGETS = {
    "this machine": ("cc", "size", ()),
    "Cortex-M4": (
        "arm-none-eabi-gcc",
        "arm-none-eabi-size",
        ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"),
    ),
}

_PROBE = """\
#include "policy.h"
void controller_step(csac_state *state, const float *observation, float *action);
void controller_step(csac_state *state, const float *observation, float *action)
{
    csac_step(state, observation, action);
}
"""


class Size(NamedTuple):
    """Bytes of a C artefact for one target, without the mathematical library's own."""

    target: str
    code: int
    constants: int
    """What can stay in flash: weights and bounds."""
    data: int
    """Memory that is taken for ever, but for the csac_state that the caller keeps."""
    stack: int
    """At most, of one step."""


def sizes(folder: Path, on_skip: Callable[[str], object] = lambda line: None) -> list[Size]:
    """Return the sizes of the C artefact in a folder, compiled with -O2 for each target whose compiler is here.

    A target whose tools do not work here is left out, and `on_skip` called with a line that says why.

    Raises:
        InputError: no artefact there, a header that is not csac's own, or `cc` does not take it.
    """
    contract, measured = ArtefactContract.load(folder), []
    with header_alone(folder, contract) as place:
        for target, (compiler, lister, options) in TARGETS.items():
            if not (shutil.which(compiler) and shutil.which(lister)):
                continue
            try:
                measured.append(_size(place, target, compiler, lister, options))
            except _ToolFailure as error:
                on_skip(f"no size for {target}: {error}")
    return measured


class _ToolFailure(Exception):
    """A tool of a target does not work here, which says nothing of the artefact."""


def _size(place: Path, target: str, compiler: str, lister: str, options: tuple[str, ...]) -> Size:
    source, made = place / "probe.c", place / "probe.o"
    source.write_text(_PROBE)
    try:
        compile_c(*C_STANDARD, *options, "-O2", "-fstack-usage", "-c", source, "-o", made, program=compiler)
    except InputError as error:
        if compiler == "cc":
            raise
        raise _ToolFailure(str(error)) from error  # such as one without the headers of a C library
    listed = subprocess.run([lister, "-A", made], capture_output=True, text=True)
    if listed.returncode:
        raise _ToolFailure(f"{lister} fails: {' '.join(listed.stderr.split())}")
    stack = sum(int(line.split("\t")[1]) for line in made.with_suffix(".su").read_text().splitlines())
    bytes_of = _bytes_of(listed.stdout)
    if not any(bytes_of.values()):
        raise _ToolFailure(f"{lister} lists none of the sections {', '.join(bytes_of)}")
    return Size(target, bytes_of["text"], bytes_of["rodata"], bytes_of["data"] + bytes_of["bss"], stack)


def _bytes_of(listed: str) -> dict[str, int]:
    """Return the bytes of each kind of section, such as `.text.csac_step`, in what `size -A` lists."""
    bytes_of = {"text": 0, "rodata": 0, "data": 0, "bss": 0}
    for line in listed.splitlines():
        words = line.split()
        kind = words[0].split(".")[1] if words and words[0].startswith(".") else ""
        if kind in bytes_of:
            bytes_of[kind] += int(words[1])
    return bytes_of
