"""What the doctor asks of the program itself: interpreter, packages, and what only a child process may try."""

from __future__ import annotations

import json
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from pipeline.adapters import self_test
from pipeline.adapters.system_packages import INSTALL_RENDERER, INSTALL_TEXT
from pipeline.commands.doctor_answer import Answer, State
from pipeline.errors import CaseRejected

#: A trial takes seconds; one that needs this long hangs.
TRIAL_SECONDS = 120.0
#: Of the sealed child, which does nothing.
SEAL_SECONDS = 20.0
SETUP = "Install again what is missing: make setup"

_DISTRIBUTION = "ct2lut"
_TRIAL = f"import sys; from {self_test.__name__} import answer; sys.stdout.write(chr(10) + answer(sys.argv[1]))"
_ROOT = str(Path(__file__).resolve().parents[2])
_COMPILE = "Compile it once, as the user who installed the program: ct2lut compile"
_PLACE = "Name a folder that stays, for every run, and compile once: export NUMBA_CACHE_DIR=FOLDER; ct2lut compile"
_SEAL = (
    "Runs go on and say so. Full protection needs Linux 5.13 or newer with Landlock (cat /sys/kernel/security/lsm)"
    " and, in a container, the runtime's own seccomp profile."
)
_SEAL_FAILS = "Use the container runtime's own seccomp profile, and see 'limits' below; then: ct2lut doctor"
#: Part of the seal, in the order of ``sandbox.SEALED``.
_PARTS = ("seccomp", "Landlock")


@dataclass(frozen=True)
class Told:
    """How a trial in a child process ended.

    Attributes
    ----------
    seconds : float
        From its start to its end, with the loading of libraries.
    found : str
        Empty where it failed.
    problem, action : str
        What went wrong, beginning with a verb or a noun, and what to do about it where the trial knows.
    """

    seconds: float
    found: str = ""
    problem: str = ""
    action: str = ""


def interpreter() -> Answer:
    """Which Python this is, against what the package asks for."""
    from packaging.specifiers import SpecifierSet  # noqa: PLC0415 - where it is missing, that is an answer

    version, wanted = platform.python_version(), metadata.metadata(_DISTRIBUTION)["Requires-Python"] or ""
    found = f"{platform.python_implementation()} {version} (expected {wanted})"
    if SpecifierSet(wanted).contains(version, prereleases=True):
        return Answer(found)
    return Answer(found, State.FAIL, "Install a newer Python and name it: make setup PYTHON=python3.12")


def packages() -> Answer:
    """Every package that a run needs, against the bounds that the package declares."""
    from packaging.requirements import Requirement  # noqa: PLC0415 - as above

    declared = [Requirement(text) for text in metadata.requires(_DISTRIBUTION) or ()]
    wanted = [one for one in declared if one.marker is None or one.marker.evaluate({"extra": ""})]
    wrong = [text for one in wanted if (text := _wrong(one.name, str(one.specifier)))]
    if wrong:
        return Answer(f"{len(wrong)} of {len(wanted)}: {'; '.join(wrong)}", State.FAIL, SETUP)
    return Answer(f"all {len(wanted)} there, in the expected versions")


def _wrong(name: str, bounds: str) -> str:
    """What is wrong with a package; empty when nothing is."""
    from packaging.specifiers import SpecifierSet  # noqa: PLC0415 - as above

    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return f"{name} is missing"
    if not SpecifierSet(bounds).contains(version, prereleases=True):
        return f"{name} {version}, expected {bounds}"
    return ""


def solver() -> Answer:
    """Whether the machine code of the solver is there."""
    told = try_in_child("solver")
    if told.problem:
        return Answer(f"it cannot be used: {told.problem}", State.FAIL, told.action or _COMPILE)
    if told.found == self_test.NO_PLACE:
        return Answer("its machine code has no folder that can be written to", State.FAIL, _PLACE)
    if told.found == self_test.NOT_COMPILED:
        return Answer("not compiled: the first run waits about 60 s for it", State.LOOK, _COMPILE)
    return Answer(f"compiled ({told.seconds:.1f} s)")


def renderer() -> Answer:
    """Whether pictures can be drawn without a screen, and by what."""
    told = try_in_child("renderer")
    if told.problem:
        action = told.action or f"Install the software renderer: {INSTALL_RENDERER}"
        return Answer(f"pictures cannot be drawn: {told.problem}", State.FAIL, action)
    return Answer(f"{told.found} ({told.seconds:.1f} s)")


def text() -> Answer:
    """Whether ``report.pdf`` can be written."""
    told = try_in_child("text")
    if told.problem:
        action = told.action or f"Install them: {INSTALL_TEXT}"
        return Answer(f"report.pdf cannot be written: {told.problem}", State.FAIL, action)
    return Answer(f"{told.found} ({told.seconds:.1f} s)")


def sealing() -> Answer:
    """Whether the child process that reads foreign files can be sealed, in the way a run does it."""
    from pipeline.engine.sandbox import SEALED  # noqa: PLC0415 - pydantic, whose absence is an answer

    try:
        said = " ".join(_unsealed())
    except CaseRejected:
        return Answer("a sealed process cannot work here: no file could be read", State.FAIL, _SEAL_FAILS)
    lacking = [part for part, place in zip(_PARTS, SEALED, strict=True) if place in said]
    if lacking:
        return Answer(f"only partly: {' and '.join(lacking)} cannot be used here", State.LOOK, _SEAL)
    return Answer(f"{' and '.join(_PARTS)} protect the reading of foreign files")


def _unsealed() -> list[str]:
    """What a run would warn of when it seals a child."""
    from pipeline.engine.confinement import Confinement, Made, confined  # noqa: PLC0415 - as above
    from pipeline.engine.stage import Limits, Stage, StrictParams  # noqa: PLC0415 - as above

    said: list[str] = []
    stage = Stage(0, "doctor", (), (), StrictParams, lambda *_: (), limits=Limits(wall_s=SEAL_SECONDS))
    with confined(Confinement(stage, (), (), lambda *_: None, said.append), lambda _: Made((), {})) as result:
        result()
    return said


def try_in_child(trial: str) -> Told:
    """One of ``self_test.TRIALS`` in a process of its own, which may crash or hang."""
    begun = time.perf_counter()
    try:
        # not in the folder of the user: without a home, libraries leave their caches where they stand
        done = subprocess.run(  # noqa: S603 - our own interpreter with a constant text
            [sys.executable, "-P", "-c", _TRIAL, trial],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(_import_path())},
            cwd="/",
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=TRIAL_SECONDS,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Told(TRIAL_SECONDS, problem=f"no end after {TRIAL_SECONDS:.0f} s")
    return _told(done, time.perf_counter() - begun)


def _import_path() -> Iterator[str]:
    yield _ROOT
    for place in filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep)):
        yield str(Path(place).absolute())


def _told(done: subprocess.CompletedProcess[bytes], seconds: float) -> Told:
    if done.returncode:
        name = signal.strsignal(-done.returncode) if done.returncode < 0 else ""
        return Told(seconds, problem=f"exit {done.returncode}" + (f" ({name})" if name else ""))
    # libraries may write to standard output before
    return Told(seconds, **json.loads(done.stdout.rpartition(b"\n")[2]))
