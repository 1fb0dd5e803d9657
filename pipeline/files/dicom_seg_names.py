"""What the segments of a DICOM SEG are: structure names and the side of the body, from their labels and codes.

Codes: DICOM PS3.16 (CID 2, 4031 and 7150 to 7199), SNOMED CT and the older SNOMED RT codes that stand for the same.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.engine.stage import Finding, Severity
from pipeline.files.dicom_tags import Tags
from pipeline.files.foreign_image import bad_header
from pipeline.files.markups import snake_case

_BONES = ("femur", "tibia", "patella", "fibula")
_SIDES = frozenset(("right", "left"))
#: Whole word of a code; SNOMED CT first, then SNOMED RT.
_WORDS = {
    code: word
    for word, codes in {
        "femur": "71341001 T-12710 310652005 T-D078D",  # the second pair is its distal part
        "tibia": "12611008 T-12740",
        "patella": "64234005 T-12730",
        "fibula": "87342007 T-12750",
        "bone": "272673000 T-D016E",
        "cartilage": "309312004 T-D021B",
        "meniscus": "74135004 T-15009",
        "medial": "255561001 R-404D5",
        "lateral": "49370004 G-A104",
        "right": "24028007 G-A100",
        "left": "7771000 G-A101",
    }.items()
    for code in codes.split()
}
_SCHEMES = ("SCT", "SRT", "SNM3")
_UNKNOWN = "unknown"
#: Words of type, place and modifiers -> structure.
_STRUCTURES = {
    **{frozenset(words): bone for bone in _BONES for words in ((bone,), (bone, "bone"))},
    frozenset(("cartilage", "femur")): "femoral_cartilage",
    frozenset(("cartilage", "patella")): "patellar_cartilage",
    **{frozenset(("cartilage", "tibia", end)): f"{end}_tibial_cartilage" for end in ("medial", "lateral")},
    **{frozenset(("meniscus", end)): f"{end}_meniscus" for end in ("medial", "lateral")},
}
_KNOWN = frozenset(_STRUCTURES.values())
#: Where a segment says what it is, where that is, and how both are to be taken.
_TYPE, _PLACE = "SegmentedPropertyTypeCodeSequence", "AnatomicRegionSequence"
_MODIFIERS = ("SegmentedPropertyTypeModifierCodeSequence", "AnatomicRegionModifierSequence")


@dataclass(frozen=True)
class Segment:
    """One item of the SegmentSequence.

    Attributes
    ----------
    number : int
        Its label value.
    label : str
        What its author calls it; may hold anything, so it never goes into a message.
    coded : str
        The structure that its codes name; empty where they name none that is known.
    side : str
        ``right``, ``left`` or empty, of its codes.
    """

    number: int
    label: str
    coded: str
    side: str

    @property
    def plain(self) -> str:
        """The structure that its label names; empty where it names none that is known."""
        name = snake_case(self.label)
        return name if name in _KNOWN else ""

    @property
    def shown(self) -> str:
        """What a message may call it."""
        known = self.plain or self.coded
        return f"segment {self.number}" + (f" ({known})" if known else "")


def read_segments(tags: Tags, file: str) -> tuple[Segment, ...]:
    """The segments that a file describes, without the background.

    Raises
    ------
    CaseRejected
        E-IO-13 for one without a number of its own, and where there is none.
    """
    items = tags.items("SegmentSequence")
    segments = tuple(_segment(item, file) for item in items)
    numbers = Counter(segment.number for segment in segments)
    if not numbers:
        raise bad_header(file, "it describes no segment")
    if max(numbers.values()) > 1:
        raise bad_header(file, f"segment {max(numbers, key=numbers.__getitem__)} is described more than once")
    return tuple(segment for segment in segments if segment.number)


def values_by_name(segments: Sequence[Segment], file: str) -> dict[str, int]:
    """Name -> label value: the label where it is a structure, else the structure that the codes name, else the label.

    Codes that more than one segment claims name none of them: they are those of two legs.

    Raises
    ------
    CaseRejected
        E-IO-13 when two segments have the same name.
    """
    plain = {segment.plain for segment in segments}
    claims = Counter(segment.coded for segment in segments if not segment.plain)
    out: dict[str, int] = {}
    for segment in segments:
        code_names_it = segment.coded not in plain and claims[segment.coded] == 1
        name = segment.plain or (segment.coded if code_names_it else "") or segment.label
        if not name:
            continue
        if name in out:
            raise bad_header(file, f"segments {out[name]} and {segment.number} have the same name")
        out[name] = segment.number
    return out


def side_of(segments: Sequence[Segment]) -> str:
    """``right`` or ``left`` where every coded structure that tells a side tells this one, else empty."""
    sides = {segment.side for segment in segments if segment.coded and segment.side}
    return sides.pop() if len(sides) == 1 else ""


def contradictions(segments: Sequence[Segment], file: str) -> tuple[Finding, ...]:
    """A warning for segments whose label names one structure and whose codes another."""
    found = [one for one in segments if one.plain and one.coded and one.plain != one.coded]
    if not found:
        return ()
    named = ", ".join(f"{one.plain} (coded as {one.coded})" for one in found)
    text = f"Segments of {file} whose names and codes differ: {named}; the names were believed."
    return (Finding("W-LBL-04", Severity.REVIEW, text),)


def _segment(item: Tags, file: str) -> Segment:
    number = item.short("SegmentNumber")
    if number is None:
        raise bad_header(file, "a segment has no number")
    label = " ".join("".join(item.texts("SegmentLabel")[:1]).split())
    words = _words(item)
    coded = _STRUCTURES.get(words - _SIDES, "")
    sides = sorted(words & _SIDES)
    return Segment(number, label, coded, sides[0] if len(sides) == 1 else "")


def _words(item: Tags) -> frozenset[str]:
    """The words of all codes of a segment; a place that is not known says nothing."""
    types, places = item.items(_TYPE), item.items(_PLACE)
    modifiers = [code for one in (item, *types, *places) for keyword in _MODIFIERS for code in one.items(keyword)]
    said = {_word(code) for code in (*types, *modifiers)}
    return frozenset(said | ({_word(code) for code in places} - {_UNKNOWN}))


def _word(code: Tags) -> str:
    """The word of one code; with one that is not known a segment is no structure that is."""
    scheme, value = code.text("CodingSchemeDesignator"), code.text("CodeValue")
    return _WORDS.get(value, _UNKNOWN) if scheme in _SCHEMES else _UNKNOWN
