"""How much code, data and stack a C artefact takes, as the compilers that are here say."""

from __future__ import annotations

import shutil
import subprocess
from typing import TYPE_CHECKING, NamedTuple

from csac.deploy.artefact import C_STANDARD, compile_c, header_alone
from csac.deploy.artefact_contract import ArtefactContract

if TYPE_CHECKING:
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


def sizes(folder: Path) -> list[Size]:
    """Return the sizes of the C artefact in a folder, compiled with -O2 for each target whose compiler is here.

    Raises:
        InputError: no artefact there, a header that is not csac's own, or a compiler that does not take it.
    """
    contract = ArtefactContract.load(folder)
    return [
        _size(folder, contract, target, compiler, lister, options)
        for target, (compiler, lister, options) in TARGETS.items()
        if shutil.which(compiler) and shutil.which(lister)
    ]


def _size(
    folder: Path, contract: ArtefactContract, target: str, compiler: str, lister: str, options: tuple[str, ...]
) -> Size:
    with header_alone(folder, contract) as place:
        source, made = place / "probe.c", place / "probe.o"
        source.write_text(_PROBE)
        compile_c(*C_STANDARD, *options, "-O2", "-fstack-usage", "-c", source, "-o", made, program=compiler)
        listed = subprocess.run([lister, "-A", made], capture_output=True, text=True, check=True).stdout
        stack = sum(int(line.split("\t")[1]) for line in made.with_suffix(".su").read_text().splitlines())
    bytes_of = {"text": 0, "rodata": 0, "data": 0, "bss": 0}
    for line in listed.splitlines():
        words = line.split()
        kind = words[0].split(".")[1] if words and words[0].startswith(".") else ""
        if kind in bytes_of:
            bytes_of[kind] += int(words[1])
    return Size(target, bytes_of["text"], bytes_of["rodata"], bytes_of["data"] + bytes_of["bss"], stack)
