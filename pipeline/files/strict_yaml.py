"""YAML for settings, read so that what is written is what is meant.

The core schema of YAML 1.2 (https://yaml.org/spec/1.2.2/#103-core-schema), narrowed: ``no`` and ``1:30`` are text, and
so is a number with a leading zero (``0012``), which is an identifier. Duplicate keys, anchors, aliases, tags, NaN and
infinity are refused; size and depth are bounded, so that no file can cost more than a moment.
"""

from __future__ import annotations

import math
import re

import yaml

MAX_BYTES = 65_536
MAX_DEPTH = 8

_CONSTANTS: dict[str, object] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}
_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]{0,17})")
_FLOAT = re.compile(r"[-+]?(0|[1-9][0-9]*)?(\.[0-9]*)?([eE][-+]?[0-9]+)?")
_NOT_A_NUMBER = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")


def parse_yaml(data: bytes) -> dict[str, object]:
    """The mapping that a YAML file holds.

    Parameters
    ----------
    data : bytes
        UTF-8 text of at most MAX_BYTES.

    Returns
    -------
    dict
        Values are dict, list, str, int, float, bool or None; keys are always text. Empty for an empty file.

    Raises
    ------
    ValueError
        For anything else; the message ends with the line.
    """
    if len(data) > MAX_BYTES:
        raise ValueError(f"expected at most {MAX_BYTES} bytes, got {len(data)}")
    try:
        text = data.decode("utf-8-sig")
        _check_events(text)
        root = yaml.compose(text, Loader=yaml.BaseLoader)
    except UnicodeDecodeError as error:
        raise ValueError(f"not UTF-8 text (line {data[: error.start].count(10) + 1})") from error
    except yaml.reader.ReaderError as error:
        raise ValueError(f"a control character (line {text.count(chr(10), 0, error.position) + 1})") from error
    except yaml.MarkedYAMLError as error:
        raise ValueError(_explained(error)) from error
    if root is None:
        return {}
    value = _construct(root)
    if not isinstance(value, dict):
        raise ValueError("expected keys with values, such as 'side: right' (line 1)")
    return value


def _check_events(text: str) -> None:
    """Refuse what the tree of nodes no longer shows, and depth before anything recurses."""
    depth = documents = 0
    for event in yaml.parse(text, Loader=yaml.BaseLoader):
        if getattr(event, "anchor", None) is not None:
            raise _refused("anchors and aliases (& and *) are not supported", event)
        if getattr(event, "tag", None) is not None:
            raise _refused("tags (!) are not supported", event)
        documents += isinstance(event, yaml.DocumentStartEvent)
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > MAX_DEPTH:
            raise _refused(f"nested deeper than {MAX_DEPTH} levels", event)
        if documents > 1:
            raise _refused("more than one document", event)


def _construct(node: yaml.Node) -> object:
    if isinstance(node, yaml.MappingNode):
        return _mapping(node)
    if isinstance(node, yaml.SequenceNode):
        return [_construct(item) for item in node.value]
    return _scalar(node)


def _mapping(node: yaml.MappingNode) -> dict[str, object]:
    out: dict[str, object] = {}
    for key, value in node.value:
        if not isinstance(key, yaml.ScalarNode) or not key.value:
            raise _refused("a key is not text", key)
        if key.value in out:
            raise _refused(f"key {key.value!r} is given twice", key)
        out[key.value] = _construct(value)
    return out


def _scalar(node: yaml.Node) -> object:
    text = str(node.value)
    if node.style is not None:  # type: ignore[attr-defined]  # quoted or block text
        return text
    if text in _CONSTANTS:
        return _CONSTANTS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _NOT_A_NUMBER.fullmatch(text):
        raise _refused("NaN and infinity are not numbers here", node)
    if _FLOAT.fullmatch(text) and any(character.isdigit() for character in text.partition("e")[0]):
        if not math.isfinite(value := float(text)):
            raise _refused("a number is too large", node)
        return value
    return text


def _refused(problem: str, where: yaml.Event | yaml.Node) -> ValueError:
    line = 0 if where.start_mark is None else where.start_mark.line
    return ValueError(f"{problem} (line {line + 1})")


def _explained(error: yaml.MarkedYAMLError) -> str:
    """One line from PyYAML's error: what, and in which line."""
    mark = error.problem_mark or error.context_mark
    return f"{error.problem or error.context} (line {1 if mark is None else mark.line + 1})"
