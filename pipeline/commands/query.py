"""What ``ct2lut query`` answers: the pose of a finished table, in words and numbers or for a program."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pipeline.commands.two_tables import OpenedTable
from pipeline.errors import ConfigError
from pipeline.kinematics.interpolation import Outside
from pipeline.playback import Lut
from pipeline.suggestions import shown

Float = NDArray[np.float64]
#: Six joint coordinates; the motion in scan space; the moving body's frame in the reference body's.
Frame = Literal["jcs", "scan", "femur"]

_MEANINGS = {
    "scan": "moves the moving bone from where it was scanned; scan space, LPS, mm",
    "femur": "from the moving bone's frame to that of the other; x lateral, y anterior, z proximal, mm",
}


@dataclass(frozen=True)
class Question:
    """What is asked.

    Attributes
    ----------
    flexion_deg : str
        One number, or several separated by commas.
    varus_deg : float
    frame : "jcs", "scan", "femur" or None
        None asks for all.
    clamp : bool
        Outside the table take its nearest pose.
    """

    flexion_deg: str
    varus_deg: float
    frame: Frame | None = None
    clamp: bool = False


@dataclass(frozen=True, eq=False)
class Answer:
    """Poses at N attitudes.

    Attributes
    ----------
    table : OpenedTable
    question : Question
    asked : mapping of str to (N,) float64
        Flexion and varus asked for.
    coordinates : mapping of str to (N,) float64
        The six coordinates with the attitude that was used; names end in ``_deg`` or ``_mm``.
    matrices : mapping of str to (N, 4, 4) float64
        By frame, ``scan`` and ``femur``.
    """

    table: OpenedTable
    question: Question
    asked: dict[str, Float]
    coordinates: dict[str, Float]
    matrices: dict[str, Float]

    @property
    def is_one(self) -> bool:
        """Whether one attitude was asked for."""
        return len(self.coordinates["flexion_deg"]) == 1

    @property
    def shown_coordinates(self) -> dict[str, Float]:
        """The attitude always, the other coordinates unless a matrix is asked for."""
        attitude_only = self.question.frame in ("scan", "femur")
        return {n: v for n, v in self.coordinates.items() if not attitude_only or n in ("flexion_deg", "varus_deg")}

    @property
    def shown_matrices(self) -> dict[str, Float]:
        """Those asked for, by frame."""
        return {frame: found for frame, found in self.matrices.items() if self.question.frame in (None, frame)}

    def name(self, frame: str) -> str:
        """What a matrix is called, target from source."""
        knee = self.table.content.joint == "knee"
        return {"scan": "moved_from_scan", "femur": "femur_from_tibia" if knee else "reference_from_moving"}[frame]


def answer(table: OpenedTable, question: Question) -> Answer:
    """Look poses up.

    Raises
    ------
    ConfigError
        E-LUT-02 for an attitude without a pose, E-LUT-03 for one that is not made of numbers.
    """
    given = _degrees("--flexion", question.flexion_deg), _degrees("--varus", str(question.varus_deg))
    (flexion, varus), lut = np.broadcast_arrays(*given), Lut(table.content)
    outside: Outside = "clamp" if question.clamp else "raise"
    try:
        coordinates = lut.coordinates(flexion, varus, outside)._asdict()
        scan, femur = (look_up(flexion, varus, outside) for look_up in (lut.pose, lut.reference_from_moving))
    except ValueError as error:
        problem = f"The table of {shown(table.label)} has no such pose: {error}."
        raise ConfigError("E-LUT-02", problem, "Ask for another attitude, or add --clamp.") from error
    asked = {"asked_flexion_deg": flexion, "asked_varus_deg": varus}
    return Answer(table, question, asked, coordinates, {"scan": scan, "femur": femur})


def _degrees(option: str, text: str) -> Float:
    try:
        numbers = np.array([float(word) for word in text.split(",")])
    except ValueError:
        numbers = np.array([np.nan])
    if not np.isfinite(numbers).all():
        problem = f"{option} is {shown(text)}; expected degrees."
        raise ConfigError("E-LUT-03", problem, "For example --flexion 60, or --flexion 0,30,60 for several.")
    return numbers


def json_line(found: Answer) -> str:
    """One JSON object: numbers of one attitude, lists of them for several."""
    content = found.table.content
    facts: dict[str, Any] = {"table": found.table.label, "joint": content.joint, "side": content.side}
    matrices = {found.name(frame): value for frame, value in found.shown_matrices.items()}
    values = {**found.asked, **found.shown_coordinates, **matrices}
    return json.dumps(facts | {name: (value[0] if found.is_one else value).tolist() for name, value in values.items()})


def lines(found: Answer) -> list[str]:
    """For people: one attitude in words and numbers; several as CSV, of the coordinates or of the matrix asked for."""
    return list(_one(found) if found.is_one else _csv(found))


def _one(found: Answer) -> Iterator[str]:
    content, (flexion, varus) = found.table.content, found.asked.values()
    yield f"{found.table.label}   {content.side} {content.joint}"
    if (flexion[0], varus[0]) != (found.coordinates["flexion_deg"][0], found.coordinates["varus_deg"][0]):
        yield f"flexion {flexion[0]:g}, varus {varus[0]:g} deg has no pose; the nearest that has one:"
    for name, value in found.shown_coordinates.items():
        words, _, unit = name.rpartition("_")
        yield f"{words.replace('_', ' '):<18} {_tidy(value[0], 4):10.4f} {unit}"
    for frame, matrix in found.shown_matrices.items():
        yield f"{found.name(frame)}: {_MEANINGS[frame]}"
        yield from ("  ".join(f"{_tidy(number, 6):12.6f}" for number in row) for row in matrix[0])


def _csv(found: Answer) -> Iterator[str]:
    columns = {**(found.asked if found.question.clamp else {}), **found.shown_coordinates}
    if found.question.frame in found.matrices:
        matrix = found.matrices[found.question.frame]
        columns |= {f"m{i}{j}": matrix[:, i, j] for i in range(4) for j in range(4)}
    yield ",".join(columns)
    yield from (",".join(f"{_tidy(number, 9):.10g}" for number in row) for row in np.transpose([*columns.values()]))


def _tidy(number: float, digits: int) -> float:
    """Rounded, without the sign of a zero."""
    return round(float(number), digits) + 0.0
