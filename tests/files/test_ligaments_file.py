"""Ligament tables: what is read, and that every fault is refused with its line."""

from __future__ import annotations

import pytest

from pipeline.errors import CaseRejected
from pipeline.files.ligaments_file import DEFAULT_STIFFNESS_N, MAX_BYTES, read_ligaments
from pipeline.records import LigamentFibre

HEADER = "name,reference_x,reference_y,reference_z,moving_x,moving_y,moving_z,slack_mm,stiffness_n,kind"
ACL = "ACL am,1.5,-2,30.25,4,5,-6,28.5,820,spring"
LCL = "LCL,-40,0,0,-35,1,-50,,600,"
CORD = "PCL,5,10,0,6,12,-30,31,,cord"
FIBRES = (
    LigamentFibre("ACL am", (1.5, -2.0, 30.25), (4.0, 5.0, -6.0), 28.5, 820.0),
    LigamentFibre("LCL", (-40.0, 0.0, 0.0), (-35.0, 1.0, -50.0), None, 600.0),
    LigamentFibre("PCL", (5.0, 10.0, 0.0), (6.0, 12.0, -30.0), 31.0, None),
)


def table(*lines: str) -> bytes:
    return ("\n".join(lines) + "\n").encode()


def refused(code: str, problem: str) -> pytest.RaisesExc[CaseRejected]:
    return pytest.raises(CaseRejected, match=f"^{code} .*{problem}")


WHOLE = table(HEADER, ACL, LCL, CORD)


@pytest.mark.parametrize(
    "data",
    [
        WHOLE,
        WHOLE.replace(b"\n", b"\r\n"),
        b"\xef\xbb\xbf" + WHOLE,
        WHOLE.rstrip(b"\n"),
        WHOLE.replace(b"\n", b"\n\n"),
        WHOLE.replace(b",", b" , "),
        WHOLE.replace(b"ACL am", b'"ACL am"'),
    ],
    ids=["plain", "windows", "byte order mark", "no last newline", "empty lines", "blanks", "quotes"],
)
def test_every_spelling_gives_the_same_fibres(data: bytes) -> None:
    assert read_ligaments(data, "ligaments.csv") == FIBRES


def test_columns_in_any_order() -> None:
    lines = [",".join(reversed(line.split(","))) for line in (HEADER, ACL, LCL, CORD)]
    assert read_ligaments(table(*lines), "ligaments.csv") == FIBRES


def test_optional_columns_may_be_missing() -> None:
    short = [",".join(line.split(",")[:7]) for line in (HEADER, ACL)]
    (fibre,) = read_ligaments(table(*short), "ligaments.csv")
    assert fibre == LigamentFibre("ACL am", (1.5, -2.0, 30.25), (4.0, 5.0, -6.0), None, DEFAULT_STIFFNESS_N)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"", "it is empty"),
        (b" \n\n", "it is empty"),
        (table(HEADER), "no line below its header"),
        (table(ACL), "no column name"),
        (table(HEADER.replace("moving_y", "tibia_y"), ACL), r"no column moving_y \(the header is 'name,.*tibia_y"),
        (table(HEADER.replace(",", ";"), ACL.replace(",", ";")), "no column name"),
        (table(HEADER + ",slack_mm", ACL + ",3"), "the column slack_mm is given twice"),
        (table(HEADER + ",moving_x", ACL + ",3"), "the column moving_x is given twice"),
        (table(HEADER.replace("slack_mm", "slack"), ACL), "the column 'slack' is not known"),
        (table(HEADER + ",", ACL + ","), "the column '' is not known"),
        (table(HEADER, ACL, LCL.replace("LCL", 'L"CL"x').replace("-40", '"-40')), "line 3 has broken quotes"),
        (WHOLE.decode().encode("utf-16"), "not UTF-8"),
        (b"x" * (MAX_BYTES + 1), "at most 1000000"),
    ],
)
def test_tables_that_are_not_read(data: bytes, problem: str) -> None:
    with refused("E-LIG-01", rf"ligaments\.csv cannot be read: .*{problem}"):
        read_ligaments(data, "ligaments.csv")


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("-40,", "forty,", "reference_x is 'forty', expected a number from -10000 to 10000"),
        ("-40,", "nan,", "reference_x is 'nan'"),
        ("-40,", "-inf,", "reference_x is '-inf'"),
        ("-40,", "1e5,", "reference_x is '1e5'"),
        ("-40,", ",", "reference_x is ''"),
        ("-50,,", "-50,nan,", "slack_mm is 'nan'"),
        ("-50,,", "-50,0,", "slack_mm is '0', expected a number from 0.001"),
        ("-50,,", "-50,-3,", "slack_mm is '-3'"),
        ("600,", "-600,", "stiffness_n is '-600'"),
        ("600,", "0,", "stiffness_n is '0'"),
        ("600,", "1e7,", "stiffness_n is '1e7', expected a number from 0.001 to 1000000"),
        ("600,", "600,rope", "kind is 'rope', expected spring or cord"),
        ("600,", "600,cord", "it is a cord, which does not stretch, but stiffness_n is 600"),
        ("600,", "600", "it has 9 cells, expected 10"),
        ("600,", "600,,", "it has 11 cells, expected 10"),
        ("LCL", "ACL am", "the name ACL am is given twice"),
        ("LCL", "", "name is '', expected 1 to 64 letters"),
        ("LCL", "<b>", "name is '<b>'"),
        ("LCL", "L" * 65, "name is 'L{65}', expected 1 to 64 letters"),
        ("-35,1,-50", "-40,0,0.05", "its two ends are the same point"),
    ],
)
def test_lines_that_are_no_fibre(old: str, new: str, problem: str) -> None:
    assert LCL.count(old) == 1
    with refused("E-LIG-02", rf"Line 3 of ligaments\.csv is not a fibre: {problem}"):
        read_ligaments(table(HEADER, ACL, LCL.replace(old, new), CORD), "ligaments.csv")


def test_the_line_is_that_of_the_file() -> None:
    with refused("E-LIG-02", "Line 5 "):
        read_ligaments(table(HEADER, "", ACL, "", LCL.replace("-40", "x")), "ligaments.csv")


def test_a_message_does_not_repeat_a_whole_file() -> None:
    with pytest.raises(CaseRejected) as caught:
        read_ligaments(table(HEADER, "L" * 100_000 + LCL), "ligaments.csv")
    assert len(str(caught.value)) < 400
