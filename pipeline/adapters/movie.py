"""A film that a browser plays: VP8 in WebM, written by OpenCV, the same bytes for the same frames.

Four traps are dealt with here. OpenCV's writer leaves out frames of another size, and ends early on a full disk,
without a word: frames are checked before and counted after. It writes only to a file, so there is a temporary one. It
prints a line about the tag of the codec that means nothing for WebM. And it names the track by a random number that
cannot be turned off: OpenCV hands no options to FFmpeg's muxer, which has one for this.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from pipeline.adapters.pictures import Image

if TYPE_CHECKING:
    import cv2

CODEC = "VP80"
#: What begins the part of the file that holds the frames.
_CLUSTER = b"\x1f\x43\xb6\x75"
#: The random number of the track (TrackUID) and its mention among the tags (TagTrackUID): element, length 8, number.
_TRACK = re.compile(rb"(\x73\xc5\x88|\x63\xc5\x88).{8}", re.DOTALL)
_FIRST_TRACK = (1).to_bytes(8, "big")


def webm(frames: Sequence[Image], frames_per_second: float) -> bytes:
    """Bytes of a film.

    Parameters
    ----------
    frames : sequence of (H, W, 3) uint8
        RGB, all of one size, height and width even: VP8 keeps one colour for two by two pixels.
    frames_per_second : float

    Raises
    ------
    ValueError
        When frames are not such, or the film cannot be written.
    """
    _check(frames)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "film.webm"
        _write(path, frames, frames_per_second)
        _check_written(path, len(frames))
        return with_fixed_track(path.read_bytes())


def with_fixed_track(film: bytes) -> bytes:
    """The same film with track number 1 in place of the random one; a film has only one track."""
    head, cluster, rest = film.partition(_CLUSTER)
    return _TRACK.sub(rb"\g<1>" + _FIRST_TRACK, head) + cluster + rest


def _check(frames: Sequence[Image]) -> None:
    if not frames:
        raise ValueError("a film needs at least one frame")
    shape = frames[0].shape
    if len(shape) != 3 or shape[2] != 3 or shape[0] % 2 or shape[1] % 2 or not all(shape):
        raise ValueError(f"expected frames (H, W, 3) of even height and width, got {shape}")
    for frame in frames:
        if frame.shape != shape or frame.dtype != np.uint8:
            raise ValueError(f"expected every frame {shape} of uint8, got {frame.shape} of {frame.dtype}")


def _write(path: Path, frames: Sequence[Image], frames_per_second: float) -> None:
    height, width = frames[0].shape[:2]
    writer = _writer(path, frames_per_second, (width, height))
    if not writer.isOpened():
        raise ValueError("OpenCV on this machine cannot write a film in WebM")
    try:
        for frame in frames:
            writer.write(np.ascontiguousarray(frame[..., ::-1]))
    finally:
        writer.release()


def _writer(path: Path, frames_per_second: float, size: tuple[int, int]) -> cv2.VideoWriter:
    import cv2  # noqa: PLC0415 - a cached run does not need it

    code = cv2.VideoWriter.fourcc(*CODEC)
    # a graphics card would make other bytes
    in_software = [cv2.VIDEOWRITER_PROP_HW_ACCELERATION, cv2.VIDEO_ACCELERATION_NONE]
    with _nothing_said():
        return cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, code, frames_per_second, size, in_software)


def _check_written(path: Path, count: int) -> None:
    import cv2  # noqa: PLC0415 - as above

    film = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        written = sum(1 for _ in iter(film.grab, False))
    finally:
        film.release()
    if written != count:
        raise ValueError(f"only {written} of the {count} frames of a film were written; the disk may be full")


@contextmanager
def _nothing_said() -> Iterator[None]:
    """Within the block nothing reaches standard error, not even what a library prints there by itself."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
