from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from pipeline.engine.store import commit_folder, fingerprint, fingerprint_on_disk, replace_file, sweep, write_file
from pipeline.errors import EnvironmentFault
from tests.engine.crash_tools import intercepted

HEX = "0123456789abcdef" * 2


def test_a_file_is_whole_although_the_system_writes_in_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, data: write(descriptor, data[:3]))
    write_file(tmp_path / "file", b"0123456789")
    assert fingerprint_on_disk(tmp_path / "file") == fingerprint(b"0123456789")


@pytest.mark.parametrize("kind", ["file", "link"])
def test_nothing_is_written_over_or_through_what_is_there(tmp_path: Path, kind: str) -> None:
    victim = tmp_path / "victim"
    victim.write_bytes(b"old")
    if kind == "link":
        (tmp_path / "link").symlink_to(victim)
    with pytest.raises(FileExistsError, match="File exists"):
        write_file(victim if kind == "file" else tmp_path / "link", b"new")
    assert victim.read_bytes() == b"old"


def test_a_disk_that_lies_is_found_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = os.write

    def lie(descriptor: int, data: Any) -> int:
        return write(descriptor, bytes(data)[:-1] + b"?")

    monkeypatch.setattr(os, "write", lie)
    with pytest.raises(EnvironmentFault, match=r"E-ENV-05 The disk did not keep"):
        commit_folder(tmp_path / "10_a", {"x": b"data"})
    assert list(tmp_path.iterdir()) == []


def test_a_committed_folder_replaces_the_old_one_as_a_whole(tmp_path: Path) -> None:
    commit_folder(tmp_path / "10_a", {"x": b"1", "only-old": b"1"})
    commit_folder(tmp_path / "10_a", {"x": b"2", "deep/er/y": b"3"})
    assert {path.name for path in tmp_path.iterdir()} == {"10_a"}
    assert {path.name for path in (tmp_path / "10_a").iterdir()} == {"x", "deep"}
    assert (tmp_path / "10_a" / "deep/er/y").read_bytes() == b"3"


def test_a_replaced_file_is_old_or_new(tmp_path: Path) -> None:
    for data in (b"1", b"2"):
        replace_file(tmp_path / "run.json", data)
        assert (tmp_path / "run.json").read_bytes() == data
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


def test_a_sweep_removes_only_what_is_ours(tmp_path: Path) -> None:
    (tmp_path / f".10_a.partial-{HEX}" / "sub").mkdir(parents=True)
    (tmp_path / f".run.json.partial-{HEX}").touch()
    (tmp_path / f".20_b.old-{HEX}").mkdir()
    (tmp_path / "20_b").mkdir()
    kept = {"20_b", ".lock", ".partial-", ".10_a.partial-short", ".quarantine-10_a-01234567", "notes.txt"}
    for name in kept - {"20_b"}:
        (tmp_path / name).touch()
    sweep(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == kept


def test_a_sweep_puts_back_a_result_whose_successor_never_came(tmp_path: Path) -> None:
    (tmp_path / f".20_b.old-{HEX}").mkdir()
    (tmp_path / f".20_b.old-{HEX}" / "x").write_bytes(b"good")
    sweep(tmp_path)
    assert (tmp_path / "20_b" / "x").read_bytes() == b"good"
    assert [path.name for path in tmp_path.iterdir()] == ["20_b"]


def test_everything_is_on_disk_before_it_is_published(tmp_path: Path) -> None:
    names: list[str] = []
    with intercepted(names.append):
        commit_folder(tmp_path / "10_a", {"x": b"1", "stage.json": b"2"})
    file = ["open", "fchmod", "write", "fsync"]
    assert [name for name in names if name not in {"mkdir", "chmod"}] == [
        *file,
        *file,
        "fsync",
        "rename",
        "rename",
        "fsync",
    ]
