"""A segmentation program of the site, run on a CT: files in, files out, a limit of time, and nothing left behind."""

from __future__ import annotations

import os
import re
import selectors
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO

import nibabel
import numpy as np

from pipeline.engine.storage_faults import storage
from pipeline.errors import CaseRejected, EnvironmentFault
from pipeline.files.case_files import MAX_FILE_BYTES
from pipeline.files.volumes import LabelMap, read_label_map
from pipeline.geometry.volume import CtVolume, corner_points
from pipeline.records import Side

#: Largest distance of a corner of the label map from that of the CT: rounding of a header.
SAME_GRID_MM = 1e-3
#: What is kept of the end of what a program says about errors, and how much of its last line a message quotes.
MAX_TAIL_BYTES = 16_384
MAX_QUOTE = 160

_POLL_S = 0.1
_LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])
_PLACEHOLDER = re.compile(r"\{(ct|labels|side)\}")
#: Colours of a terminal; whatever else is not printable.
_TERMINAL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
#: What looks like a path, in quotes or not.
_PATH = re.compile(r"'[^']*[/\\][^']*'|\"[^\"]*[/\\][^\"]*\"|\S*[/\\]\S*")

_ASK_SITE = "Tell whoever looks after the program's protocol; it says which command is run."


@dataclass(frozen=True)
class CommandCall:
    """A program as the site sets it up.

    Attributes
    ----------
    words : tuple of str
        Program and arguments; ``{ct}``, ``{labels}`` and ``{side}`` stand for what changes from case to case.
    title : str
        As messages name it; no path.
    limit_s : float
        It is ended after so many seconds.
    """

    words: tuple[str, ...]
    title: str
    limit_s: float


@dataclass(frozen=True)
class Ending:
    """How a program ended: its exit code (negative: the signal that ended it) and the end of what it said on stderr."""

    code: int
    tail: bytes


def label_map_of(call: CommandCall, ct: CtVolume, side: Side) -> LabelMap:
    """Run a program on a CT and read the label map that it leaves.

    Parameters
    ----------
    call : CommandCall
    ct : CtVolume
        Index axes near +L, +P, +S. The program gets it as compressed NIfTI.
    side : "right" or "left"

    Returns
    -------
    LabelMap
        On the grid of the CT.

    Raises
    ------
    EnvironmentFault
        E-SEG-02 when the program cannot be started, E-ENV-* when the CT cannot be written for it.
    CaseRejected
        E-SEG-03 when it fails, E-SEG-04 when it takes too long, E-SEG-05 when it leaves no label map, E-SEG-06 when
        that lies on another grid; those of :func:`~pipeline.files.volumes.read_label_map`.
    """
    with storage(f"Writing the CT for {call.title}"):
        folder = TemporaryDirectory(prefix="ct2lut-", ignore_cleanup_errors=True)
    with folder as name:
        ct_file, labels_file = Path(name) / "ct.nii.gz", Path(name) / "labels.nii.gz"
        with storage(f"Writing the CT for {call.title}"):
            _write_nifti(ct, ct_file)
        values = {"ct": str(ct_file), "labels": str(labels_file), "side": side}
        ending = run_limited(call, filled_in(call.words, values), Path(name))
        if ending.code != 0:
            raise CaseRejected("E-SEG-03", f"{call.title} failed: it {_how(ending)}.", _ASK_SITE)
        data = _left(labels_file, call)
    labels = read_label_map(data, f"{call.title}: {labels_file.name}")
    _check_grid(labels, ct, call)
    return labels


def filled_in(words: Sequence[str], values: Mapping[str, str]) -> list[str]:
    """The words of a command with its placeholders replaced, once: what they stand for is not looked at again."""
    return [_PLACEHOLDER.sub(lambda found: values[found[1]], word) for word in words]


def run_limited(call: CommandCall, words: Sequence[str], folder: Path) -> Ending:
    """Run a command in a folder, without a shell; neither it nor what it started outlives this call.

    Parameters
    ----------
    call : CommandCall
        For its limit and for messages.
    words : sequence of str
        Program and arguments.
    folder : Path
        Where it runs.

    Raises
    ------
    EnvironmentFault
        E-SEG-02.
    CaseRejected
        E-SEG-04.
    """
    try:
        process = subprocess.Popen(  # noqa: S603 - what the site configured; a case cannot (config.py)
            words,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
    except OSError as error:
        problem = f"{call.title} cannot be started: {error.strerror}."
        raise EnvironmentFault("E-SEG-02", problem, "Install it on this computer. " + _ASK_SITE) from error
    tail = b""
    try:
        tail = _followed(process, call)
    finally:
        # before the leader is waited for: until then its number is not given to another group
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        if process.stderr is not None:
            process.stderr.close()
    return Ending(process.returncode, tail)


def last_words(tail: bytes) -> str:
    """The last line of what a program said, fit to be quoted: short, printable, without paths; may be empty.

    Parameters
    ----------
    tail : bytes
    """
    text = _TERMINAL.sub("", tail.decode(errors="replace"))
    lines = ["".join(c if c.isprintable() else " " for c in line).strip() for line in text.splitlines()]
    last = next((line for line in reversed(lines) if line), "")
    return " ".join(_PATH.sub("…", last).split())[:MAX_QUOTE]


def _followed(process: subprocess.Popen[bytes], call: CommandCall) -> bytes:
    """What the program says on stderr until it ends; whoever inherited the pipe does not keep us waiting."""
    deadline, tail = time.monotonic() + call.limit_s, b""
    stream = process.stderr
    if stream is None:
        raise ValueError("the program was started without a pipe")
    os.set_blocking(stream.fileno(), False)
    with selectors.DefaultSelector() as selector:
        selector.register(stream, selectors.EVENT_READ)
        while not _has_ended(process):
            if time.monotonic() > deadline:
                limit = f"{call.limit_s / 60:.0f} min" if call.limit_s >= 120 else f"{call.limit_s:g} s"
                raise CaseRejected(
                    "E-SEG-04",
                    f"{call.title} took longer than {limit} and was ended.",
                    "Run again when the computer is less busy, or raise segment.command_limit_s in the protocol.",
                )
            if selector.get_map():
                selector.select(_POLL_S)
                tail, more = _read_on(stream, tail)
                if not more:
                    selector.unregister(stream)
            else:
                time.sleep(_POLL_S)
    return _read_on(stream, tail)[0]


def _has_ended(process: subprocess.Popen[bytes]) -> bool:
    """Without reaping it, so that its process group can still be named."""
    return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None


def _read_on(stream: IO[bytes], tail: bytes) -> tuple[bytes, bool]:
    """The last bytes of a pipe after reading what it holds, at most a few megabytes; whether there may be more."""
    for _ in range(256):
        try:
            data = os.read(stream.fileno(), MAX_TAIL_BYTES)
        except BlockingIOError:
            return tail, True
        if not data:
            return tail, False
        tail = (tail + data)[-MAX_TAIL_BYTES:]
    return tail, True


def _how(ending: Ending) -> str:
    words = last_words(ending.tail)
    how = f"was ended by signal {-ending.code}" if ending.code < 0 else f"ended with code {ending.code}"
    return f'{how} and said "{words}"' if words else how


def _write_nifti(ct: CtVolume, file: Path) -> None:
    image = nibabel.Nifti1Image(ct.values, _LPS_FROM_RAS @ ct.lps_from_index)
    image.header.set_xyzt_units("mm")
    image.set_sform(image.affine, 1)
    image.set_qform(image.affine, 1)
    image.to_filename(file)


def _left(file: Path, call: CommandCall) -> bytes:
    """The bytes of the label map that the program left."""
    problem = "left no label map"
    if file.is_file() and (size := file.stat().st_size) > 0:
        if size <= MAX_FILE_BYTES:
            with storage(f"Reading what {call.title} left"):
                return file.read_bytes()
        problem = f"left a label map of {size / 1e9:.1f} GB, expected at most {MAX_FILE_BYTES / 1e9:.0f} GB"
    action = "The command must write a label map in NIfTI to the path that stands for {labels}. " + _ASK_SITE
    raise CaseRejected("E-SEG-05", f"{call.title} ended well but {problem}.", action)


def _check_grid(labels: LabelMap, ct: CtVolume, call: CommandCall) -> None:
    shape, expected = labels.volume.values.shape, ct.values.shape
    if shape != expected:
        problem = f"has {_size(shape)} voxels, the CT {_size(expected)}"
    else:
        corners = (corner_points(volume.lps_from_index, shape) for volume in (labels.volume, ct))
        apart = float(np.linalg.norm(np.subtract(*corners), axis=1).max())
        if apart <= SAME_GRID_MM:
            return
        problem = f"lies up to {apart:.3g} mm off the CT, expected at most {SAME_GRID_MM:g} mm"
    action = "The command must keep the voxels of the CT. " + _ASK_SITE
    raise CaseRejected("E-SEG-06", f"The label map that {call.title} left {problem}.", action)


def _size(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))
