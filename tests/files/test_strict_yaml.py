"""YAML that means what it says."""

from __future__ import annotations

import json
import math

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from pipeline.files.strict_yaml import MAX_BYTES, MAX_DEPTH, parse_yaml


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("right", "right"),
        ("no", "no"),
        ("yes", "yes"),
        ("on", "on"),
        ("1:30", "1:30"),
        ("0012", "0012"),
        ("0o14", "0o14"),
        ("0x1F", "0x1F"),
        ("1_000", "1_000"),
        ("2026-01-31", "2026-01-31"),
        ("'12'", "12"),
        ('"true"', "true"),
        ("12", 12),
        ("-3", -3),
        ("0", 0),
        ("1e3", 1000.0),
        ("-0.5", -0.5),
        (".5", 0.5),
        ("5.", 5.0),
        ("true", True),
        ("False", False),
        ("null", None),
        ("", None),
        ("~", None),
        ("[1, a, [2.5]]", [1, "a", [2.5]]),
        ("{b: 1, 5: no}", {"b": 1, "5": "no"}),
        ("=", "="),
        (".", "."),
        ("e3", "e3"),
        ("+", "+"),
    ],
)
def test_values(text: str, value: object) -> None:
    found = parse_yaml(f"key: {text}\n".encode())["key"]
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"a: 1\nb: 2\na: 3\n", r"key 'a' is given twice \(line 3\)"),
        (b"a:\n  b: 1\n  b: 1\n", r"key 'b' is given twice \(line 3\)"),
        (b"a: &x 1\n", r"anchors and aliases .* \(line 1\)"),
        (b"a: 1\nb: *x\n", r"anchors and aliases .* \(line 2\)"),
        (b"a: !!str 1\n", r"tags .* \(line 1\)"),
        (b"a: !!python/object/apply:os.system [x]\n", r"tags .* \(line 1\)"),
        (b"a: .nan\n", r"NaN and infinity .* \(line 1\)"),
        (b"a: -.inf\n", r"NaN and infinity .* \(line 1\)"),
        (b"a: 1e999\n", r"too large \(line 1\)"),
        (b"- 1\n", r"expected keys with values"),
        (b"text\n", r"expected keys with values"),
        (b"a: 1\n---\nb: 1\n", r"more than one document \(line 2\)"),
        (b"a: [1\n", r"\(line 2\)"),
        (b"a: b: c\n", r"mapping values are not allowed here \(line 1\)"),
        (b"a:\n\t- 1\n", r"\(line 2\)"),
        (b"? [1]\n: 2\n", r"a key is not text \(line 1\)"),
        (b"'': 2\n", r"a key is not text \(line 1\)"),
        (b"a: 1\nb: \x00\n", r"a control character \(line 2\)"),
        (b"a: 1\nb: \xff\n", r"not UTF-8 text \(line 2\)"),
        (b"a: " + b"[" * (MAX_DEPTH) + b"]" * (MAX_DEPTH), r"nested deeper than 8 levels"),
        (b"a: 1\n" + b" " * MAX_BYTES, r"at most 65536 bytes"),
    ],
)
def test_refusals_name_the_line(data: bytes, problem: str) -> None:
    with pytest.raises(ValueError, match=problem):
        parse_yaml(data)


@pytest.mark.parametrize("data", [b"", b"# only a comment\n", b"\xef\xbb\xbf", b"---\n"])
def test_nothing_is_an_empty_mapping_or_refused(data: bytes) -> None:
    if data == b"---\n":
        with pytest.raises(ValueError, match="expected keys with values"):
            parse_yaml(data)
    else:
        assert parse_yaml(data) == {}


def test_the_deepest_that_is_allowed() -> None:
    assert parse_yaml(b"a: " + b"[" * (MAX_DEPTH - 1) + b"]" * (MAX_DEPTH - 1))["a"] == [[[[[[[]]]]]]]


def test_a_byte_order_mark_and_windows_lines() -> None:
    assert parse_yaml(b"\xef\xbb\xbfside: right\r\njoint: knee\r\n") == {"side": "right", "joint": "knee"}


printable = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=8)
name = st.from_regex(r"[a-z_]{1,8}", fullmatch=True)
nested = st.recursive(
    st.none() | st.booleans() | st.integers(-(10**15), 10**15) | printable,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(name, inner, max_size=3),
    max_leaves=8,
)


@given(st.dictionaries(name, nested, max_size=4))
def test_json_means_itself(value: dict[str, object]) -> None:
    """JSON is YAML with every text quoted."""
    assert parse_yaml(json.dumps(value).encode()) == value


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_floats_as_python_writes_them(value: float) -> None:
    found = parse_yaml(f"a: {value!r}".encode())["a"]
    assert isinstance(found, (int, float))
    assert math.isclose(float(found), value, rel_tol=0.0, abs_tol=0.0)


@given(st.binary(max_size=200))
def test_any_bytes_give_a_mapping_or_a_value_error(data: bytes) -> None:
    try:
        assert isinstance(parse_yaml(data), dict)
    except ValueError as error:
        assert str(error)  # noqa: PT017 - either outcome is right, silence is not


def test_pyyaml_itself_would_have_guessed() -> None:
    """The control: what the library makes of the same text."""
    assert yaml.safe_load("a: 0012\nb: no\nc: 1:30") == {"a": 10, "b": False, "c": 90}
    assert parse_yaml(b"a: 0012\nb: no\nc: 1:30") == {"a": "0012", "b": "no", "c": "1:30"}
