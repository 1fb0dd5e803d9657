"""What a case says about itself: ``case.yaml``, or a ``labels.json`` beside the label map.

Which side a scan shows, which joint it is and which label value is which structure are facts of one case. They are
declared by whoever brings the case and never guessed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pipeline.errors import CaseRejected
from pipeline.files.strict_yaml import parse_yaml
from pipeline.suggestions import did_you_mean, listed

LABELS_FOLDER = Path(__file__).parent / "configs" / "labels"

#: A declaration is a page of text: more is something else under its name.
MAX_BYTES = 65_536

KEYS = ("side", "joint", "labels", "frames", "settings")
JSON_KEYS = ("side", "labels")
SIDES = ("right", "left")


@dataclass(frozen=True)
class CaseDeclaration:
    """The declared facts of a case; what is absent was not declared.

    Attributes
    ----------
    file : str
        Name of the file that declares them, relative to the case folder; empty where there is none.
    side : "right", "left" or None
    joint : str or None
        Name of the joint file.
    labels : dict of str to int, or None
        Structure name -> label value.
    frames : dict or None
        Given joint frames by name, such as ``scan_from_reference``, for objects that have no anatomy.
    settings : dict
        Overrides of the protocol: stage name -> settings of that stage.
    """

    file: str = ""
    side: str | None = None
    joint: str | None = None
    labels: dict[str, int] | None = None
    frames: dict[str, object] | None = None
    settings: dict[str, object] = field(default_factory=dict)


def read_declaration(case_folder: Path) -> CaseDeclaration:
    """The declaration of a case; an empty one where neither file exists.

    Raises
    ------
    CaseRejected
        E-CASE-01 unreadable, E-CASE-02 unknown key, E-CASE-03 wrong value, E-CASE-04 the two files contradict each
        other, E-CASE-05 unknown label preset.
    """
    from_yaml = _read(case_folder / "case.yaml", parse_yaml, _from_yaml)
    from_json = _read(case_folder / "labels.json", parse_json, _from_json)
    if from_yaml is None or from_json is None:
        return from_yaml or from_json or CaseDeclaration()
    _refuse_contradiction(from_yaml, from_json)
    return CaseDeclaration(
        file=from_yaml.file,
        side=from_yaml.side or from_json.side,
        joint=from_yaml.joint,
        labels=from_yaml.labels or from_json.labels,
        frames=from_yaml.frames,
        settings=from_yaml.settings,
    )


def parse_json(data: bytes) -> dict[str, object]:
    """A JSON object, strictly: UTF-8, no duplicate keys, no NaN.

    Raises
    ------
    ValueError
        For anything else.
    """
    document = json.loads(data.decode("utf-8-sig"), object_pairs_hook=_unique, parse_constant=_refuse_constant)
    if not isinstance(document, dict):
        raise ValueError("expected names and values in { }")
    return document


def label_presets() -> tuple[str, ...]:
    """Names of the label schemes that come with the program."""
    return tuple(sorted(path.stem for path in LABELS_FOLDER.glob("*.yaml")))


def label_preset(name: str) -> dict[str, object]:
    """Structures with their label values, as a label scheme that comes with the program lists them.

    Raises
    ------
    ValueError
        When there is none of that name; the message says what may have been meant.
    """
    if name not in label_presets():
        raise ValueError(f"the label scheme {name!r} is not known{did_you_mean(name, label_presets())}")
    return parse_yaml((LABELS_FOLDER / f"{name}.yaml").read_bytes())


def _unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
    names = [name for name, _ in pairs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"the name {twice[0]!r} appears twice")
    return dict(pairs)


def _refuse_constant(word: str) -> None:
    raise ValueError(f"{word} is not a number")


def _read(
    path: Path,
    parse: Callable[[bytes], dict[str, object]],
    interpret: Callable[[dict[str, object]], CaseDeclaration],
) -> CaseDeclaration | None:
    if not path.is_file():
        return None
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise ValueError(f"larger than {MAX_BYTES} bytes")
        document = parse(data)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise CaseRejected(
            "E-CASE-01", f"{path.name} cannot be read: {reason}.", f"Correct or remove {path.name} and run again."
        ) from error
    return interpret(document)


def _from_yaml(document: dict[str, object]) -> CaseDeclaration:
    file = "case.yaml"
    for key in document:
        if key not in KEYS:
            problem = f"{file}: {key!r} is not a known key{did_you_mean(key, KEYS)}; the keys are {listed(KEYS)}."
            raise CaseRejected("E-CASE-02", problem, f"Correct the key in {file} and run again.")
    return CaseDeclaration(
        file=file,
        side=_side(document.get("side"), file),
        joint=_joint(document.get("joint"), file),
        labels=_labels(document.get("labels"), file),
        frames=_mapping(document.get("frames"), file, "frames"),
        settings=_mapping(document.get("settings"), file, "settings") or {},
    )


def _from_json(document: dict[str, object]) -> CaseDeclaration:
    """Other keys (spacing, sizes) are what a segmentation tool adds; intake measures those in the label map itself."""
    file = "labels.json"
    values = _mapping(document.get("labels"), file, "labels")
    labels = None if values is None else _labels_by_structure(values, file)
    return CaseDeclaration(file=file, side=_side(document.get("side"), file), labels=labels)


def _labels_by_structure(values: Mapping[str, object], file: str) -> dict[str, int]:
    labels: dict[str, int] = {}
    for text, name in values.items():
        structure = str(name).strip().lower().replace(" ", "_")
        if not text.isdecimal() or not isinstance(name, str) or structure in labels:
            raise _wrong(file, f"labels: {text!r}", name, "a label value and the name of one structure")
        labels[structure] = int(text)
    return labels


def _side(value: object, file: str) -> str | None:
    if value is None or value in SIDES:
        return None if value is None else str(value)
    raise _wrong(file, "side", value, "right or left")


def _joint(value: object, file: str) -> str | None:
    if value is None or isinstance(value, str):
        return value
    raise _wrong(file, "joint", value, "the name of a joint, such as knee")


def _labels(value: object, file: str) -> dict[str, int] | None:
    if value is None:
        return None
    mapping = _preset(value, file) if isinstance(value, str) else value
    if not isinstance(mapping, dict):
        raise _wrong(file, "labels", value, "the name of a label scheme, or structures with their label values")
    for structure, number in mapping.items():
        if not isinstance(number, int) or isinstance(number, bool):
            raise _wrong(file, f"labels: {structure}", number, "a whole number")
    return dict(mapping)


def _preset(name: str, file: str) -> dict[str, object]:
    try:
        return label_preset(name)
    except ValueError as error:
        action = f"Use one of {listed(label_presets())}, or list each structure with its label value."
        raise CaseRejected("E-CASE-05", f"{file}: {error}.", action) from error


def _mapping(value: object, file: str, key: str) -> dict[str, object] | None:
    if value is None or isinstance(value, dict):
        return value
    raise _wrong(file, key, value, "names and values, indented below it")


def _wrong(file: str, key: str, got: object, expected: str) -> CaseRejected:
    return CaseRejected(
        "E-CASE-03", f"{file}: {key} is {got!r}; expected {expected}.", f"Correct {key} in {file} and run again."
    )


def _refuse_contradiction(one: CaseDeclaration, other: CaseDeclaration) -> None:
    """A structure that only one file lists is no contradiction: a scheme may name more than one map holds."""
    difference = _side_difference(one.side, other.side) or _label_difference(one.labels or {}, other.labels or {})
    if difference:
        problem = f"{one.file} and {other.file} contradict each other: {difference}."
        raise CaseRejected("E-CASE-04", problem, f"Correct the wrong one, or remove {other.file}, and run again.")


def _side_difference(first: str | None, second: str | None) -> str:
    return f"side is {first} in one and {second} in the other" if first and second and first != second else ""


def _label_difference(first: Mapping[str, int], second: Mapping[str, int]) -> str:
    for name in sorted(first.keys() & second.keys()):
        if first[name] != second[name]:
            return f"{name} is label {first[name]} in one and label {second[name]} in the other"
    structure_of = {value: name for name, value in first.items()}
    for name, value in sorted(second.items()):
        if structure_of.get(value, name) != name:
            return f"label {value} is {structure_of[value]} in one and {name} in the other"
    return ""
