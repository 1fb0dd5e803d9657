from __future__ import annotations

import json
from pathlib import Path

from pipeline.engine.runlog import LogLine, RunLog, error_id, printable, private_traceback


def test_a_line_stays_one_line_whatever_is_in_it(tmp_path: Path) -> None:
    log = RunLog(tmp_path / "log.jsonl", "P1")
    message = "a\nb\r\x1b[2J\x00\x7f\x85\u2028\u202e\ud800é"
    log.write(LogLine("warning", message, "mesh", "W-X-01", 1.23456))
    log.write(LogLine("info", "next"))
    data = (tmp_path / "log.jsonl").read_bytes()
    assert all(0x20 <= byte < 0x7F or byte == 0x0A for byte in data)
    first, second = (json.loads(line) for line in data.splitlines())
    assert (first["msg"], first["seconds"], first["code"]) == (message, 1.235, "W-X-01")
    assert (second["stage"], second["seconds"]) == (None, None)


def test_a_log_that_cannot_be_written_stops_nothing(tmp_path: Path) -> None:
    (tmp_path / "victim").write_text("untouched")
    (tmp_path / "log.jsonl").symlink_to(tmp_path / "victim")
    RunLog(tmp_path / "log.jsonl", "P1").write(LogLine("info", "x"))
    RunLog(tmp_path / "no" / "log.jsonl", "P1").write(LogLine("info", "x"))
    assert (tmp_path / "victim").read_text() == "untouched"


def test_printable_escapes_all_that_is_not() -> None:
    assert printable("a\x1b[0m\nb\u202eé") == "a\\x1b[0m\\nb\\u202eé"


def failure(text: str) -> Exception:
    try:
        try:
            raise KeyError(text)
        except KeyError as error:
            raise ValueError(f'cannot read /data/{text}/ct.dcm near "{text}"; shape (3, 4)') from error
    except ValueError as error:
        return error


def test_a_traceback_shows_where_and_not_whose() -> None:
    text = private_traceback(failure("DOE"))
    assert "DOE" not in text
    assert "/data" not in text
    assert text.count("test_runlog.py:") == 2
    assert "KeyError: …" in text
    assert "ValueError: cannot read … near …; shape (3, 4)" in text


def test_the_number_of_an_error_depends_on_the_place_only() -> None:
    assert error_id(failure("a")) == error_id(failure("b"))
    assert len(error_id(failure("a"))) == 8
