"""Names of labels as a BIDS look-up table has them, to the names that this program knows."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping

from pipeline.case_declaration import label_presets
from pipeline.files.markups import snake_case
from pipeline.suggestions import shown

#: What a name of a structure may be, and how many a case may declare (``stages/intake.py``).
_STRUCTURE = re.compile(r"[a-z][a-z0-9_]{0,63}")
MAX_STRUCTURES = 255
MAX_VALUE = 65_535

_SIDES = ("left", "right")
#: Noun, adjective.
_BONES = (("femur", "femoral"), ("tibia", "tibial"), ("patella", "patellar"), ("fibula", "fibular"))
_HALVES = ("medial", "lateral")


def _spellings() -> Iterator[tuple[frozenset[str], str]]:
    """The words of a name, in any order -> our name; a name with any other word is not known."""
    for noun, adjective in _BONES:
        for words in ((noun,), (noun, "bone"), (adjective, "bone"), ("distal", noun), ("proximal", noun)):
            yield frozenset(words), noun
    for noun, adjective in (_BONES[0], _BONES[2]):
        for word in (noun, adjective):
            yield frozenset((word, "cartilage")), f"{adjective}_cartilage"
    for half in _HALVES:
        yield frozenset((half, "meniscus")), f"{half}_meniscus"
        for word in _BONES[1]:
            yield frozenset((half, word, "cartilage")), f"{half}_tibial_cartilage"


_KNOWN = dict(_spellings())


def structure_name(name: str) -> str:
    """Our name of a structure, ``Medial meniscus`` -> ``medial_meniscus``, or its own in lower case where we have none.

    A side, written out, stays as an ending: ``Left femur`` -> ``femur_left``. Single letters are left alone, since L
    may be left or lateral.
    """
    plain = snake_case(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name))
    words = plain.split("_")
    sides = [word for word in words if word in _SIDES]
    found = _KNOWN.get(frozenset(words) - frozenset(_SIDES))
    if found is None or len(sides) > 1 or len(set(words)) < len(words):
        return plain
    return "_".join((found, *sides))


def labels_of_table(rows: list[dict[str, str]]) -> dict[str, int]:
    """Structure -> label value, of the rows of a ``dseg.tsv``; names that a case cannot declare are left out.

    Raises
    ------
    ValueError
        Without the columns ``index`` and ``name``, for a value that is no label, and for two values of a structure or
        two structures of a value.
    """
    values: dict[str, int] = {}
    names: dict[int, str] = {}
    for row in rows:
        if "index" not in row or "name" not in row:
            raise ValueError(f"its columns are {shown(list(row))}, expected index and name among them")
        value, structure = _value(row["index"]), structure_name(row["name"])
        if value in names:
            raise ValueError(f"label {value} is both {shown(names[value])} and {shown(structure)}")
        names[value] = structure
        if value == 0 or not _STRUCTURE.fullmatch(structure):
            continue
        if structure in values and _is_ours(structure):
            raise ValueError(f"labels {values[structure]} and {value} are both {structure}")
        values.setdefault(structure, value)
    return _declarable(values)


def preset_of(entities: Mapping[str, str]) -> str | None:
    """The label scheme of ours that ``seg-`` or ``desc-`` names; labels of BIDS have no underscores.

    Raises
    ------
    ValueError
        When they name two of them.
    """
    presets = {_plain(name): name for name in label_presets()}
    named = {presets.get(_plain(entities.get(entity, ""))) for entity in ("seg", "desc")} - {None}
    if len(named) > 1:
        raise ValueError("seg- and desc- name different label schemes")
    return next(iter(named), None)


def _value(text: str) -> int:
    if not (text.isascii() and text.isdecimal() and int(text) <= MAX_VALUE):
        raise ValueError(f"index {shown(text)} is no label; expected a whole number from 0 to {MAX_VALUE}")
    return int(text)


def _declarable(values: Mapping[str, int]) -> dict[str, int]:
    """As many as a case may declare, those that we know first."""
    order = sorted(values, key=lambda name: (not _is_ours(name), values[name]))
    return {name: values[name] for name in order[:MAX_STRUCTURES]}


def _is_ours(structure: str) -> bool:
    return structure.removesuffix("_left").removesuffix("_right") in _KNOWN.values()


def _plain(text: str) -> str:
    return re.sub(r"[^a-z0-9]", "", text.lower())
