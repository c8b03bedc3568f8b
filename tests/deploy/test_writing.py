"""Where artefacts go: whole or not at all, over an older artefact and over nothing else."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path

import pytest
from policies import algorithm_policy

from csac.deploy.artefact_contract import ArtefactContract
from csac.deploy.writing import check_place, placed, write_artefact
from csac.types import InputError


def test_what_is_raised_on_the_way_leaves_nothing_behind(tmp_path):
    def fail():
        with placed(tmp_path / "export" / "c") as folder:
            (folder / "policy.h").touch()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert list((tmp_path / "export").iterdir()) == []


def test_an_older_artefact_is_replaced_and_nothing_else(tmp_path):
    place, policy = tmp_path / "made", algorithm_policy("td3")

    def put(version: int) -> None:
        with placed(place) as folder:
            write_artefact(folder, policy.network, ArtefactContract(policy.contract, "numpy"))
            fields = json.loads((folder / "contract.json").read_text())
            (folder / "contract.json").write_text(json.dumps(fields | {"artefact_version": version}))

    def version() -> int:
        return json.loads((place / "contract.json").read_text())["artefact_version"]

    put(0)  # one that an older csac wrote
    put(2)
    assert version() == 2
    (place / "__pycache__").mkdir()  # which Python leaves where the loader was imported
    put(3)
    assert version() == 3
    assert {path.name for path in place.iterdir()} == {"contract.json", "policy.py", "policy.safetensors"}
    (place / "notes.txt").touch()
    with pytest.raises(InputError, match="holds something else than an artefact"), placed(place):
        pass
    with pytest.raises(InputError, match="is a file"), placed(place / "notes.txt"):
        pass
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made"]


@pytest.mark.parametrize(
    "kept", ["a saved policy", "a contract of somebody's", "no JSON", "no policy", "another policy"]
)
def test_what_only_looks_like_an_artefact_is_not_replaced(tmp_path, kept):
    place, policy = tmp_path / "kept", algorithm_policy("td3")
    if kept == "a saved policy":
        policy.save(place)
    elif kept in ("no policy", "another policy"):
        place.mkdir()
        write_artefact(place, policy.network, ArtefactContract(policy.contract, "numpy"))
        (place / "policy.safetensors").rename(place / ("policy.h" if kept == "another policy" else "README.md"))
    else:
        place.mkdir()
        (place / "contract.json").write_text("{" if kept == "no JSON" else '{"file": "policy.h", "parties": 2}')
        (place / "README.md").write_text("Ours.")
    before = {path.name: path.read_bytes() for path in place.iterdir()}
    with pytest.raises(InputError, match="holds something else than an artefact"):
        check_place(place)
    assert {path.name: path.read_bytes() for path in place.iterdir()} == before


class Broken:
    """`os.rename` that raises at its call `at`."""

    def __init__(self, at: int, error: BaseException) -> None:
        self.at, self.error, self.calls, self.rename = at, error, 0, os.rename

    def __call__(self, source: Path, target: Path) -> None:
        self.calls += 1
        if self.calls == self.at:
            raise self.error
        self.rename(source, target)


def put(place: Path, text: str) -> None:
    policy = algorithm_policy("td3")
    with placed(place) as folder:
        write_artefact(folder, policy.network, ArtefactContract(policy.contract, "numpy", provenance={"text": text}))


def found(place: Path) -> str:
    return json.loads((place / "contract.json").read_text())["provenance"]["text"]


@pytest.mark.parametrize("error", [OSError(errno.EBUSY, "Device or resource busy"), KeyboardInterrupt()])
@pytest.mark.parametrize("at", [1, 2])
def test_the_older_artefact_is_there_whatever_happens_while_it_is_replaced(tmp_path, monkeypatch, at, error):
    place = tmp_path / "made"
    put(place, "older")
    monkeypatch.setattr(os, "rename", Broken(at, error))
    expected = InputError if isinstance(error, OSError) else KeyboardInterrupt
    with pytest.raises(expected) as caught:
        put(place, "newer")
    if expected is InputError:
        assert str(caught.value) == f"cannot write to {place}: Device or resource busy; choose another place"
    assert found(place) == "older"
    assert list(tmp_path.iterdir()) == [place]


def test_an_older_artefact_that_cannot_be_put_back_is_kept_aside(tmp_path, monkeypatch):
    place, broken = tmp_path / "made", Broken(2, OSError(errno.EIO, "Input/output error"))
    put(place, "older")

    def rename(source: Path, target: Path) -> None:
        if broken.calls >= 2:
            raise broken.error
        broken(source, target)

    monkeypatch.setattr(os, "rename", rename)
    with pytest.raises(InputError, match="Input/output error"):
        put(place, "newer")
    (aside,) = tmp_path.iterdir()
    assert found(aside / "old") == "older"


def test_where_there_was_none_the_cause_is_told(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "rename", Broken(2, OSError(errno.EIO, "Input/output error")))
    with pytest.raises(InputError, match=r"cannot write to .*made: Input/output error; choose another place"):
        put(tmp_path / "made", "new")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_told_in_one_line_and_leaves_nothing(tmp_path):
    def fill() -> None:
        with placed(tmp_path / "made"):
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(InputError, match=r"cannot write to .*made: No space left on device; choose another place"):
        fill()
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_replaced_is_refused_at_once(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    (tmp_path / "file").touch()
    monkeypatch.chdir(tmp_path / "here")
    for place in (".", tmp_path / "here", "../here", "/"):
        with pytest.raises(InputError, match="is where you are, or where a disk is mounted, and cannot be replaced"):
            check_place(Path(place))
    with pytest.raises(InputError, match=r"cannot write to .*: File name too long; choose another place"):
        check_place(tmp_path / ("x" * 300))
    with pytest.raises(InputError, match=f"cannot write into {tmp_path / 'file'}: choose a folder that is yours"):
        check_place(tmp_path / "file" / "export" / "c")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "here"]


def test_a_link_to_an_artefact_stays_a_link(tmp_path):
    put(tmp_path / "made", "older")
    (tmp_path / "link").symlink_to("made")
    put(tmp_path / "link", "newer")
    assert (tmp_path / "link").is_symlink()
    assert found(tmp_path / "made") == "newer"
