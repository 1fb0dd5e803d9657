"""Lists of cases: what is read, and what is refused before anything starts."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pipeline.cohort import case_list
from pipeline.cohort.case_list import listed_cases
from pipeline.cohort.model import ListedCase
from pipeline.errors import ConfigError


def folders(root: Path, *names: str) -> Path:
    for name in names:
        (root / name).mkdir(parents=True)
    return root


def written(root: Path, content: str | bytes, name: str = "list.csv") -> Path:
    path = root / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def ids(cases: Path) -> list[str]:
    return [case.case_id for case in listed_cases(cases)]


# A folder


def test_each_subfolder_is_a_case_sorted_by_its_name(tmp_path: Path) -> None:
    folders(tmp_path, "P2", "P10", "0012", ".hidden", "@eaDir", "lost+found", "__MACOSX")
    (tmp_path / "notes of the study.txt").write_text("")
    assert listed_cases(tmp_path) == tuple(ListedCase(name, tmp_path / name) for name in ("0012", "P10", "P2"))


def test_links_to_folders_count_and_links_to_files_do_not(tmp_path: Path) -> None:
    cases = folders(tmp_path / "cases", "P1")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "a file").write_text("")
    (cases / "P2").symlink_to(tmp_path / "elsewhere")
    (cases / "notes.txt").symlink_to(tmp_path / "a file")
    assert ids(cases) == ["P1", "P2"]


@pytest.mark.parametrize("target", ["not-mounted", "P2"])
def test_a_link_that_leads_nowhere_is_refused_as_a_case_and_not_forgotten(tmp_path: Path, target: str) -> None:
    folders(tmp_path, "P1")
    (tmp_path / "P2").symlink_to(target)
    assert ids(tmp_path) == ["P1", "P2"]


def test_a_folder_that_is_a_link_or_relative(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders(tmp_path / "cases", "P1")
    (tmp_path / "link").symlink_to("cases")
    monkeypatch.chdir(tmp_path)
    assert listed_cases(Path("link")) == (ListedCase("P1", tmp_path / "link" / "P1"),)


def test_names_that_are_no_ids_refuse_the_folder(tmp_path: Path) -> None:
    folders(tmp_path, "P1", "Doe John", "a\nb", "\u202egnp", "z z", "CON")
    with pytest.raises(ConfigError, match=r"E-LST-04 .* cannot be case IDs: ") as caught:
        listed_cases(tmp_path)
    assert caught.value.problem.endswith(r'"CON", "Doe John", "a\nb" and 2 more.')
    assert "Rename or move them, or use a .csv list" in caught.value.action


def test_a_name_that_is_not_utf_8_is_shown_in_plain_letters(tmp_path: Path) -> None:
    Path(os.fsdecode(os.fsencode(tmp_path) + b"/P\xff")).mkdir()
    with pytest.raises(ConfigError, match="E-LST-04 ") as caught:
        listed_cases(tmp_path)
    assert caught.value.problem.isascii()
    assert caught.value.problem.isprintable()


@pytest.mark.fault("I04")
def test_names_that_differ_only_in_case_refuse_the_folder(tmp_path: Path) -> None:
    folders(tmp_path, "p1", "P1", "P2")
    with pytest.raises(ConfigError, match=r"E-LST-05 .* upper and lower case: P1 and p1"):
        listed_cases(tmp_path)


@pytest.mark.parametrize("name", ["absent", "absent.csv", "list.txt", "list.csv/x"])
def test_neither_a_folder_nor_a_list(tmp_path: Path, name: str) -> None:
    written(tmp_path, "id\nP1\n", "list.txt")
    written(tmp_path, "id\nP1\n")
    with pytest.raises(ConfigError, match=r"E-LST-01 .* neither a folder nor a .csv list"):
        listed_cases(tmp_path / name)


def test_nothing_to_do(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"E-LST-08 .* holds no case"):
        listed_cases(tmp_path)
    with pytest.raises(ConfigError, match=r"E-LST-08 .* holds no case"):
        listed_cases(written(tmp_path, "id,folder\n\n# P1\n"))


# A list


@pytest.mark.fault("I05")
@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("bom", [b"", b"\xef\xbb\xbf"])
def test_separators_line_ends_and_bom(tmp_path: Path, separator: str, end: str, bom: bytes) -> None:
    folders(tmp_path, "0012", "other/x y")
    rows = ["ID,Remark,Folder", '"0012","a|b",', "P2,,other/x y"]
    text = end.join(rows).replace(",", separator).replace("|", ",")
    found = listed_cases(written(tmp_path, bom + text.encode()))
    assert found == (ListedCase("0012", tmp_path / "0012"), ListedCase("P2", tmp_path / "other" / "x y"))


def test_folders_are_relative_to_the_list_absolute_or_beside_it(tmp_path: Path) -> None:
    far = folders(tmp_path / "far", "a")
    place = folders(tmp_path / "lists", "P3")
    folders(tmp_path, "near")
    found = listed_cases(written(place, f"id,folder\nP1,{far}/a\nP2, ../near \nP3,\n", "LIST.CSV"))
    assert [case.folder.resolve() for case in found] == [far / "a", tmp_path / "near", place / "P3"]
    assert all(case.folder.is_absolute() for case in found)


def test_what_is_passed_over(tmp_path: Path) -> None:
    folders(tmp_path, "P1", "P2", "P3")
    text = 'sep=;\n\n# don\'t "quote\n id ;remark\n\nP1;"first\n\n# 2"" screw"\n;;;\n# P9\n  \nP2;x;;\nP3\n'
    assert ids(written(tmp_path, text)) == ["P1", "P2", "P3"]


def test_a_header_with_a_line_break(tmp_path: Path) -> None:
    folders(tmp_path, "P1")
    assert ids(written(tmp_path, '"id";"date of\nscan"\n"P1";"1 May"\n')) == ["P1"]


def refused(tmp_path: Path, content: str | bytes, match: str) -> str:
    with pytest.raises(ConfigError, match=match) as caught:
        listed_cases(written(tmp_path, content))
    return caught.value.problem


@pytest.mark.fault("I05")
@pytest.mark.parametrize("cell", ["=1+1", "@SUM(A1)", "../x", "-rf", "P1 ", "a.b", "Doe^John", "CON", "x" * 65, ""])
def test_cells_that_are_no_ids(tmp_path: Path, cell: str) -> None:
    problem = refused(tmp_path, f"id,name\nP1,x\n# skip\n{cell},x\n", "E-LST-04 .* IDs that are not valid: line 4")
    assert problem.isprintable()


@pytest.mark.fault("I05")
def test_the_first_three_lines_are_named(tmp_path: Path) -> None:
    problem = refused(tmp_path, 'remark,id\n"two\nlines",+1\nx,=2\nx,OK\nx,-3\nx,@4\n', "E-LST-04 ")
    assert problem.endswith('line 2 ("+1"), line 4 ("=2"), line 6 ("-3") and 1 more.')


@pytest.mark.fault("I05")
def test_the_same_id_twice(tmp_path: Path) -> None:
    folders(tmp_path, "P1", "x")
    problem = refused(tmp_path, "id,folder\nP1,\nP2,x\np1,x\nP1,x\n", "E-LST-05 ")
    assert problem.endswith('line 2 and line 4 ("p1"), line 2 and line 5 ("P1").')


@pytest.mark.fault("I05")
@pytest.mark.parametrize("folder", ["absent", "list.csv", "list.csv/x", "loop", "x" * 300])
def test_folders_that_are_not_there(tmp_path: Path, folder: str) -> None:
    folders(tmp_path, "P1")
    (tmp_path / "loop").symlink_to("loop")
    problem = refused(tmp_path, f"id,folder\nP1,P1\nP2,{folder}\n", "E-LST-06 ")
    assert problem.endswith('line 3 ("P2").')


@pytest.mark.fault("I05")
def test_one_folder_under_two_ids(tmp_path: Path) -> None:
    folders(tmp_path, "P1", "P3")
    (tmp_path / "link").symlink_to("P1")
    problem = refused(tmp_path, "id,folder\nP1,\nP3,\nP2,./P3/../link\n", "E-LST-07 ")
    assert problem.endswith('line 2 ("P1") and line 4 ("P2").')


@pytest.mark.fault("I05")
@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("id\nP1\n".encode("utf-16"), "encoding is not UTF-8"),
        (b"id,name\nP1,M\xfcller\n", r"encoding is not UTF-8 \(line 2\)"),
        (b"id\nP1\0\n", "characters with the code 0"),
        (b"i\0d\0\n\0P\x001\0\n\0", "characters with the code 0"),
    ],
)
def test_what_is_no_text(tmp_path: Path, content: bytes, why: str) -> None:
    assert "ller" not in refused(tmp_path, content, f"E-LST-02 .*{why}")


@pytest.mark.fault("I05")
def test_a_list_that_is_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(case_list, "MAX_BYTES", 10)
    refused(tmp_path, "id\n12345678\n", "E-LST-02 .* has more than")


@pytest.mark.parametrize("header", ["", "case,folder", "P1,P1", "id,id", "id,folder,Folder", "id|folder"])
def test_a_list_without_the_names_of_its_columns(tmp_path: Path, header: str) -> None:
    refused(tmp_path, f"{header}\nP1,P1\n" if header else "", "E-LST-03 .* expected names of columns")


@pytest.mark.fault("I05")
@pytest.mark.parametrize(
    ("row", "why"),
    [
        ('P2,"open\nP3,x', "unexpected end of data"),
        ('P2,"5" screw', "',' expected after"),
        ("P2,a,b", "it has 3 cells, expected 2"),
        (f"P2,{'x' * 200_000}", "field larger than field limit"),
    ],
)
def test_rows_that_cannot_be_divided(tmp_path: Path, row: str, why: str) -> None:
    folders(tmp_path, "P1")
    refused(tmp_path, f"id,folder\nP1,\n{row}\n", f"E-LST-09 .* begins on line 3 .*{why}")


def test_a_tab_is_told_in_letters_that_can_be_printed(tmp_path: Path) -> None:
    problem = refused(tmp_path, 'id\tfolder\nP2\t"5" screw\n', "E-LST-09 ")
    assert problem.isprintable()


def test_what_cannot_be_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(*_: object) -> bytes:
        raise PermissionError(13, "denied")

    path = written(tmp_path, "id\nP1\n")
    monkeypatch.setattr(Path, "read_bytes", denied)
    with pytest.raises(ConfigError, match="E-LST-01 "):
        listed_cases(path)


@given(st.lists(st.sampled_from([*'iP12;,\t"\n\r# =./é\x1c\u2028', "\nP1", "\nP2", "\r", ",folder"]), max_size=20))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=150)
def test_any_list_is_read_or_refused_in_plain_words(tmp_path: Path, parts: list[str]) -> None:
    for name in ("P1", "P2"):
        (tmp_path / name).mkdir(exist_ok=True)
    path = written(tmp_path, "".join(["id", *parts]))
    known = {"P1", "P2"}
    try:
        assert set(ids(path)) <= known
    except ConfigError as error:
        told = (error.code[:6], error.problem.isprintable())
    else:
        told = ("E-LST-", True)
    assert told == ("E-LST-", True)
