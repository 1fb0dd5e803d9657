"""The values of one level of a DICOM data set, taken from their raw bytes and never guessed at.

Format: DICOM PS3.5 chapter 6 (value representations).
"""

from __future__ import annotations

import re
import struct
from typing import Any

_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
_INTEGER = re.compile(r"[+-]?[0-9]{1,10}")
_WORD = re.compile(r"[A-Za-z0-9_ ./+-]{1,32}")
#: What pydicom raises for bytes that are no data set.
PARSE_ERRORS = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
)


class Tags:
    """Raw values of one level of a data set; remembers in ``faults`` what was there and could not be used.

    Parameters
    ----------
    dataset : pydicom.Dataset
        As read: an element whose value was asked for before is taken to be of another kind.
    """

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self.faults: dict[str, str] = {}

    def items(self, keyword: str) -> tuple[Tags, ...]:
        """The items of a sequence; empty when it is absent.

        Raises
        ------
        PARSE_ERRORS
            For bytes that are no items.
        """
        if keyword not in self._dataset:
            return ()
        element = self._dataset[keyword]
        if element.VR != "SQ":
            self.faults[keyword] = "is not a sequence"
            return ()
        return tuple(Tags(item) for item in element.value)

    def raw(self, keyword: str) -> bytes:
        """The bytes of an element; empty when it is absent."""
        from pydicom.dataelem import RawDataElement  # noqa: PLC0415 - as in _read_data_set

        if keyword not in self._dataset:
            return b""
        element = self._dataset.get_item(keyword)
        if not isinstance(element, RawDataElement):
            self.faults[keyword] = "is not of its kind"
            return b""
        return bytes(element.value or b"")

    def texts(self, keyword: str) -> tuple[str, ...]:
        """The values of a text element without padding; empty when it is absent."""
        raw = self.raw(keyword).decode("latin-1").strip(" \0")
        return tuple(text.strip(" \0") for text in raw.split("\\")) if raw else ()

    def text(self, keyword: str) -> str:
        """The first value of a text element that is a plain word, else empty."""
        first = (*self.texts(keyword), "")[0]
        return first if _WORD.fullmatch(first) else ""

    def decimals(self, keyword: str, count: int) -> tuple[float, ...] | None:
        """Exactly ``count`` finite numbers; None otherwise."""
        texts = self.texts(keyword)
        if not texts:
            return None
        if len(texts) != count or not all(_DECIMAL.fullmatch(text) for text in texts):
            self.faults[keyword] = "is not a number" if count == 1 else f"is not {count} numbers"
            return None
        numbers = tuple(float(text) for text in texts)
        if not all(abs(number) < 1e300 for number in numbers):
            self.faults[keyword] = "is not finite"
            return None
        return numbers

    def decimal(self, keyword: str) -> float | None:
        """One finite number, or None."""
        numbers = self.decimals(keyword, 1)
        return None if numbers is None else numbers[0]

    def short(self, keyword: str, *, signed: bool = False) -> int | None:
        """One number of 16 bits, or None."""
        if not (raw := self.raw(keyword)):
            return None
        if len(raw) != 2:
            self.faults[keyword] = "is not one number"
            return None
        little = self._dataset.get_item(keyword).is_little_endian
        return int.from_bytes(raw, "little" if little else "big", signed=signed)

    def flag(self, keyword: str) -> bool | None:
        """A number that is 0 or 1, or None."""
        number = self.short(keyword)
        if number not in (None, 0, 1):
            self.faults[keyword] = "is neither 0 nor 1"
            return None
        return None if number is None else bool(number)

    def frames(self) -> int | None:
        """NumberOfFrames, 1 where it is absent, None where it is no number."""
        if not self.texts("NumberOfFrames"):
            return 1
        if (number := self.whole("NumberOfFrames")) is None:
            self.faults["NumberOfFrames"] = "is not a whole number"
        return number

    def whole(self, keyword: str) -> int | None:
        """One whole number; None where there is none that can be used, which is no fault."""
        texts = self.texts(keyword)
        return int(texts[0]) if len(texts) == 1 and _INTEGER.fullmatch(texts[0]) else None
