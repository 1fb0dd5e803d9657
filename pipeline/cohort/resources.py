"""What a batch asks of the machine or cluster: memory and time, from the sizes of its cases."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pipeline.cohort.model import CohortRequest


@dataclass(frozen=True)
class Line:
    """A need that grows with the size of a case's folder; ``per_mb`` for each MB (10^6 bytes) of its files."""

    floor: float
    per_mb: float

    def at(self, size: int) -> float:
        """The need of a case with files of so many bytes."""
        return self.floor + self.per_mb * size / 1e6


#: MB of a case with one process, as measured; see :func:`batch_resources`.
MEMORY_MB = Line(1000.0, 12.0)
#: MB of each further process of a case.
PROCESS_MB = 450.0
MEMORY_MARGIN = 1.5
#: MB of what runs beside a case in a job: the batch, and the engine that a cluster's job starts again.
BESIDE_MB = 300.0
#: Seconds of a case with one process, as measured.
TIME_S = Line(100.0, 3.0)
TIME_MARGIN = 3.0
#: Minutes of a batch beside its cases: starting, waiting for the disk.
BATCH_MIN = 1


@dataclass(frozen=True)
class Resources:
    """What a job asks for: memory in MB, whole minutes of wall time."""

    mem_mb: int
    minutes: int


def batch_resources(sizes: Sequence[int], request: CohortRequest) -> Resources:
    """Memory of the largest case, time of all: cases of a batch run one after the other.

    Lines above what was measured (2 cores shared with other work, ``--jobs 1``; resident memory of all processes of
    a case together, looked at every 0.1 s; seconds of all processors)::

        case                        protocol    files     memory    time
        phantom, labels, 1.0 mm     demo        0.03 MB    712 MB   42 s
        phantom, labels, 0.7 mm     clinical    0.08 MB    748 MB   80 s
        phantom, labels, 0.5 mm     demo        0.18 MB    778 MB   46 s
        knee of a public data set   clinical    0.33 MB    790 MB   84 s
        phantom, labels, 0.3 mm     demo        0.62 MB    990 MB   87 s
        synthetic CT, 365 slices    clinical     34 MB    1140 MB  180 s
        synthetic CT, 233 slices    clinical    108 MB    1574 MB  140 s

    Compressed labels say little of their voxels, hence floors. With ``--jobs 2`` the CT of 34 MB took 1831 MB: 875 of
    the case itself, 390 of each worker, 160 of what starts workers. What is slower than ``clinical`` by more than the
    margin comes to its end in the engine's further attempts, each of which asks for more and goes on where the last
    one was.

    Parameters
    ----------
    sizes : sequence of int
        Bytes of the source folder of each case (:func:`~pipeline.cohort.batches.look_at`).
    request : CohortRequest
        A memory limit is what its case needs; a time limit bounds the time of each case.
    """
    return Resources(math.ceil(_memory_mb(max(sizes, default=0), request)), _minutes(sizes, request))


def _memory_mb(largest: int, request: CohortRequest) -> float:
    if request.limits.memory_mb:
        return request.limits.memory_mb + BESIDE_MB
    return MEMORY_MARGIN * (MEMORY_MB.at(largest) + PROCESS_MB * (_processes(request) - 1)) + BESIDE_MB


def _processes(request: CohortRequest) -> int:
    """Of one case; 0 asks for one each core, of which nothing is known here."""
    return max(1, request.jobs)


def _minutes(sizes: Sequence[int], request: CohortRequest) -> int:
    seconds = TIME_MARGIN * sum(map(TIME_S.at, sizes))
    if request.limits.time_s:
        seconds = min(seconds, request.limits.time_s * len(sizes))
    return math.ceil(seconds / 60.0) + BATCH_MIN
