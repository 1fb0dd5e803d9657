"""Case IDs: what is refused before any path is made."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pipeline.case_id import check_case_id, refuse_twin
from pipeline.errors import ConfigError


@pytest.mark.parametrize("case_id", ["P001", "a", "0", "A-b_c", "x" * 64, "console", "com10"])
def test_good_ids(case_id: str) -> None:
    assert check_case_id(case_id) == case_id


@pytest.mark.fault("I01")
@pytest.mark.parametrize(
    "case_id",
    [
        *("", ".", "..", "../x", "/etc", "a/b", "a\\b", "-rf", "--help", "_a", " P1", "P1 ", "P1\n", "P\x001", "a b"),
        *("\u00e9", "e\u0301", "\u0420\u0031", "\uff11", "\u202eP1", "a.b", "a.", "~", "$HOME", "%", "*", "x" * 65),
        *("CON", "nul", "Com1", "LPT9", "<b>", "a;b"),
    ],
)
def test_bad_ids(case_id: str) -> None:
    with pytest.raises(ConfigError, match=r"E-ID-01 .* cannot be used as a case ID"):
        check_case_id(case_id)


@given(st.text())
def test_an_accepted_id_is_one_plain_name(text: str) -> None:
    try:
        check_case_id(text)
    except ConfigError:
        return
    assert text.isascii()
    assert Path(text).name == text
    assert text.replace("-", "").replace("_", "").isalnum()


@pytest.mark.fault("I04")
def test_twins_that_differ_in_case_only(tmp_path: Path) -> None:
    (tmp_path / "P1").mkdir()
    refuse_twin("P1", tmp_path)
    refuse_twin("P2", tmp_path)
    refuse_twin("P1", tmp_path / "absent")
    with pytest.raises(ConfigError, match="E-ID-02 The case ID p1 differs from the folder P1 only in upper and lower"):
        refuse_twin("p1", tmp_path)
