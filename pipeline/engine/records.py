"""Frozen dataclasses to canonical JSON and back, strictly."""

from __future__ import annotations

import json
from typing import Any, TypeVar

from pydantic import TypeAdapter

from pipeline.engine.artifacts import Artifact, single

T = TypeVar("T")


def canonical_json(value: Any) -> bytes:
    """JSON with sorted keys, no NaN and a final newline: equal values give equal bytes.

    Parameters
    ----------
    value : JSON-compatible object
        Floats are written with the shortest text that reads back the same.

    Raises
    ------
    ValueError
        For NaN or infinity.
    """
    return (json.dumps(value, sort_keys=True, indent=1, allow_nan=False, ensure_ascii=False) + "\n").encode()


def record_artifact(name: str, file: str, kind: type[T], schema: int = 1) -> Artifact[T]:
    """An artifact that is one JSON file holding one value of a (generic) dataclass type."""
    adapter: TypeAdapter[T] = TypeAdapter(kind)

    def encode(value: T) -> bytes:
        return canonical_json(adapter.dump_python(value, mode="json"))

    return single(name, file, encode, adapter.validate_json, schema)
