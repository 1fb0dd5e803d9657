"""The workflow engine (Snakemake) as a program of its own: found, started, followed, stopped.

One driver at a time works on a results folder. Its lock is the kernel's and is held by this process and by the engine,
but by no job: it is free as soon as neither lives, however they ended.
"""

from __future__ import annotations

import getpass
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import yaml

import pipeline
from pipeline.cohort.place import CohortPlace
from pipeline.commands.doctor_machine import total_memory, usable_processors
from pipeline.engine.lock import Held, Lock, hold, is_held
from pipeline.engine.runlog import printable
from pipeline.engine.storage_faults import storage
from pipeline.engine.store import make_folder, open_or_create, read_file
from pipeline.errors import ConfigError, EnvironmentFault
from pipeline.suggestions import did_you_mean, listed, shown

#: Variable of the environment that names the engine's program.
PROGRAM_VARIABLE = "CT2LUT_SNAKEMAKE"
#: How often the caller is told that time has passed.
TICK_S = 1.0
#: How long jobs of this machine, and a cluster that is asked to cancel its jobs, may take to end.
LOCAL_PATIENCE_S, CLUSTER_PATIENCE_S = 15.0, 75.0
#: The log of one run does not grow beyond this; the part before is kept once.
LOG_BYTES = 10_000_000
#: Share of this machine's memory that batches may ask for together.
MEMORY_SHARE = 0.8

_WORKFLOWS = Path(pipeline.__file__).parent / "workflows"
_PROFILE_FILES = ("config.yaml", "profile.yaml")
_ENGINE_LOGS = 5
_SAID_LINES, _SAID_BYTES, _SAID_SIGNS = 8, 65_536, 300
#: What the engine says of every run, or says again in other words.
_NOISE = re.compile(
    r"\[\w{3} \w{3} .*\]|(Using (profile|shell)|Config file|Assuming|Building DAG|Select jobs|Execute \d"
    r"|Trying to restart|Exiting because|Shutting down|Complete log|Elapsed time|RuleException:|WorkflowError:$"
    r"|CalledProcessError in file|At least one job did not|Removing output files|Job rate limit|Touching).*"
)
_FAILED_JOB = re.compile(r"Command '.* (?:-- (?P<batch>\S+)|cohort-summary .*)' (?P<how>returned|died)(?P<rest>.*)")

Tick = Callable[[], None]


@dataclass(frozen=True)
class Engine:
    """The engine and how it is to work.

    Attributes
    ----------
    profile : str
        Name of one of ours, or path of a Snakemake profile.
    at_once : int
        Batches at work at the same time; 0 leaves it to the machine or the profile.
    snakemake : Path
        Its program.
    """

    profile: str
    at_once: int
    snakemake: Path


@dataclass(frozen=True)
class EngineEnd:
    """Whether every batch has a result; where not, the last lines of what the engine said that a person can use."""

    ok: bool
    said: str


@dataclass(frozen=True)
class _Profile:
    path: Path
    local: bool


def find_engine(profile: str, at_once: int) -> Engine:
    """Find the engine's program and make sure of the profile.

    Parameters
    ----------
    profile : str
        Name of one of ours, or path of a Snakemake profile: a folder with ``config.yaml``, or the file.
    at_once : int
        Batches at work at the same time; 0 leaves it to the machine or the profile.

    Raises
    ------
    EnvironmentFault
        ``E-ENG-01`` when the program is not installed.
    ConfigError
        ``E-ENG-03``, ``E-ENG-04`` when the profile is not there or cannot be read.
    """
    _load_profile(profile)
    return Engine(profile, at_once, _find_program())


def run_engine(place: CohortPlace, engine: Engine, tick: Tick) -> EngineEnd:
    """Let the engine bring every batch of the plan to a result, and wait until it has ended.

    Nothing of it outlives the call; SIGKILL of this process alone leaves the engine at work, with the lock.

    Parameters
    ----------
    place : CohortPlace
        ``workflow/config.json`` and the lists of the batches are there.
    engine : Engine
        From :func:`find_engine`.
    tick : callable
        Called about once a second meanwhile.

    Raises
    ------
    EnvironmentFault
        ``E-ENG-02`` when another driver is at work here; ``E-ENG-05`` when that cannot be known.
    ConfigError
        When the profile or the plan cannot be read.
    KeyboardInterrupt
        After the engine and its jobs have been stopped.
    """
    profile = _load_profile(engine.profile)
    command = _command(place, engine, profile)
    with _driver_lock(place) as lock:
        _tidy(place, lock)
        with storage("Opening the engine's log"):
            log = open_or_create(place.engine_log, os.O_WRONLY | os.O_APPEND)
        try:
            code = _follow(_Start(command, _environment(place), log, lock), profile, _capped(place, tick))
        finally:
            os.close(log)
    return EngineEnd(code == 0, "" if code == 0 else _said(place, code))


def is_driven(place: CohortPlace) -> bool:
    """Whether a driver or its engine is at work on this results folder; changes nothing."""
    return is_held(place.lock)


def wait_for_driver(place: CohortPlace, tick: Tick) -> None:
    """Wait until no driver is at work on this results folder; ``tick`` is called about once a second meanwhile."""
    while is_driven(place):
        tick()
        time.sleep(TICK_S)


def _find_program() -> Path:
    named = os.environ.get(PROGRAM_VARIABLE)
    if named:
        found = shutil.which(named)
        if found is None:
            raise _no_engine(f"{PROGRAM_VARIABLE} names no program: {shown(named)}.")
        return Path(found).absolute()
    beside = (Path(pipeline.__file__).parents[1] / ".venv-cohort", Path(f"{sys.prefix}-cohort"))
    places = [str(folder / "bin") for folder in beside]
    for path in (*places, None):
        if found := shutil.which("snakemake", path=path):
            return Path(found).absolute()
    raise _no_engine("The workflow engine (Snakemake) is not installed.")


def _no_engine(problem: str) -> EnvironmentFault:
    action = f"In the folder of the program, type: make setup-cohort. Or name one: export {PROGRAM_VARIABLE}=FILE"
    return EnvironmentFault("E-ENG-01", problem, action)


def _load_profile(profile: str) -> _Profile:
    folder = _WORKFLOWS / "profiles"
    ours = sorted(path.name for path in folder.iterdir() if path.is_dir())
    path = folder / profile if profile in ours else Path(profile).absolute()
    file = next((path / name for name in _PROFILE_FILES if (path / name).is_file()), path)
    if not file.is_file():
        hint = did_you_mean(profile, ours)
        problem = f"There is no profile {shown(profile)}{hint}, neither of ours nor a folder with config.yaml."
        raise ConfigError("E-ENG-03", problem, f"Name one of {listed(ours)}, or the folder of a Snakemake profile.")
    return _Profile(file, _executor(file, profile) == "local")


def _executor(file: Path, profile: str) -> str:
    try:
        told = yaml.safe_load(file.read_text())
        return str(told.get("executor") or told.get("e") or "local")
    except (OSError, ValueError, AttributeError, yaml.YAMLError) as error:
        problem = f"The profile {shown(profile)} cannot be read as YAML with one 'key: value' a line."
        raise ConfigError("E-ENG-04", problem, "Compare it with pipeline/workflows/profiles.") from error


def _command(place: CohortPlace, engine: Engine, profile: _Profile) -> tuple[str, ...]:
    common = (
        *("--snakefile", str(_WORKFLOWS / "Snakefile"), "--directory", str(place.workflow.absolute())),
        *("--profile", str(profile.path), "--workflow-profile", "none", "--nocolor"),
    )
    limits = _local_limits(place, engine) if profile.local else _cluster_limits(engine)
    return (str(engine.snakemake), *common, *limits)


def _cluster_limits(engine: Engine) -> tuple[str, ...]:
    return ("--jobs", str(engine.at_once)) if engine.at_once else ()


def _local_limits(place: CohortPlace, engine: Engine) -> tuple[str, ...]:
    # a batch that asks for more than this is given this, and runs alone
    cores = engine.at_once * _threads(place) if engine.at_once else usable_processors()
    most_mb = max(1, int(MEMORY_SHARE * total_memory() / 1e6))
    return ("--cores", str(cores), "--resources", f"mem_mb={most_mb}")


def _threads(place: CohortPlace) -> int:
    try:
        return max(1, int(json.loads(read_file(place.workflow / "config.json"))["threads"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        problem = "The plan of this cohort is damaged: config.json cannot be read."
        raise ConfigError("E-ENG-06", problem, "Begin it again with the same command: ct2lut cohort.") from error


def _environment(place: CohortPlace) -> Mapping[str, str]:
    """The engine keeps what it caches with the cohort; a home that can be used stays, for the settings of clusters."""
    own = str((place.files / "engine.cache").absolute())
    home = os.environ.get("HOME", "")
    usable = home and os.access(home, os.W_OK | os.X_OK)
    return {**_user(), **os.environ, "XDG_CACHE_HOME": own, "HOME": home if usable else own}


def _user() -> Mapping[str, str]:
    """A name where the user has none, as in a container: the engine asks for it and fails without one."""
    try:
        getpass.getuser()
    except (KeyError, OSError):  # the first until Python 3.12
        return {"LOGNAME": str(os.getuid())}
    return {}


@contextmanager
def _driver_lock(place: CohortPlace) -> Iterator[Lock]:
    with storage("Opening the lock of the cohort"):
        make_folder(place.files)
    try:
        with hold(place.lock, "the lock of the cohort") as lock:
            yield lock
    except Held as held:
        problem = f"Another driver is at work on these results {held.holder}."
        raise EnvironmentFault("E-ENG-02", problem, "Wait until it ends, or stop it; nothing was changed.") from held


def _tidy(place: CohortPlace, lock: Lock) -> None:
    """Clear away what killed engines left, and the oldest logs."""
    own = place.workflow / ".snakemake"
    left = own / "locks"
    if not lock.sure and left.is_dir() and any(left.iterdir()):
        problem = "This file system has no locks, and the engine's own mark says that another driver may be at work."
        action = "When none is, remove the folder cohort.files/workflow/.snakemake/locks in the results folder."
        raise EnvironmentFault("E-ENG-05", problem, action)
    shutil.rmtree(left, ignore_errors=True)
    logs = sorted((own / "log").glob("*.log"))
    for log in logs[: 1 - _ENGINE_LOGS]:
        with suppress(OSError):
            log.unlink()
    with storage("Keeping the engine's last log"), suppress(FileNotFoundError):
        place.engine_log.rename(_older(place))


def _older(place: CohortPlace) -> Path:
    return place.engine_log.with_name(f"{place.engine_log.name}.1")


def _capped(place: CohortPlace, tick: Tick) -> Tick:
    """``tick``, and no longer a log than is useful."""

    def both() -> None:
        with suppress(OSError):
            if place.engine_log.stat().st_size > LOG_BYTES:
                shutil.copyfile(place.engine_log, _older(place))
                os.truncate(place.engine_log, 0)
        tick()

    return both


@dataclass(frozen=True)
class _Start:
    command: Sequence[str]
    environment: Mapping[str, str]
    log: int
    lock: Lock


def _follow(start: _Start, profile: _Profile, tick: Tick) -> int:
    """Start the engine and wait until it ends; its exit code."""
    with _late_signals() as deliver:
        process = _popen(start)
        try:
            deliver()
            start.lock.sign(f", engine {process.pid}")
            while process.poll() is None:
                with suppress(subprocess.TimeoutExpired):
                    process.wait(TICK_S)
                tick()
        finally:
            _stop(process, profile)
    return process.returncode


def _popen(start: _Start) -> subprocess.Popen[bytes]:
    with storage("Starting the workflow engine"):
        return subprocess.Popen(  # noqa: S603 -- a program that we found, with arguments of ours
            start.command,
            env=start.environment,
            stdin=subprocess.DEVNULL,
            stdout=start.log,
            stderr=start.log,
            start_new_session=True,
            pass_fds=(start.lock.descriptor,),
            umask=0o027,
        )


@contextmanager
def _late_signals() -> Iterator[Callable[[], None]]:
    """Keep signals that ask us to end until the yielded function is called: then it is known what has to be stopped.

    It also gives the new program the default behaviour: a shell starts what runs in the background with SIGINT ignored,
    and the engine would never hear that it is to end.
    """
    kept: list[int] = []

    def keep(number: int, _: FrameType | None) -> None:
        kept.append(number)

    before = {number: signal.signal(number, keep) for number in (signal.SIGINT, signal.SIGTERM)}

    def deliver() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)
        while kept:
            signal.raise_signal(kept.pop())

    try:
        yield deliver
    finally:
        deliver()


def _stop(process: subprocess.Popen[bytes], profile: _Profile) -> None:
    """End the engine and what it left; both have ended already in the ordinary case.

    SIGINT makes the engine start nothing more and cancel the jobs of a cluster, but it waits for those of this machine,
    so these are asked to end too. SIGTERM would make it wait for all.
    """
    until = time.monotonic() + (LOCAL_PATIENCE_S if profile.local else CLUSTER_PATIENCE_S)
    asked: set[int] = set()
    process.send_signal(signal.SIGINT)  # nothing where it has ended
    try:
        while (there := _session(process.pid)) and time.monotonic() < until:
            # commands by which the engine cancels the jobs of a cluster are not to be stopped
            if profile.local or process.poll() is not None:
                asked |= _ask(_jobs(there, process.pid) - asked)
            time.sleep(0.05)
            process.poll()
    finally:
        while there := _session(process.pid):
            for pid in there:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            time.sleep(0.02)
            process.poll()
        process.wait()


def _ask(jobs: set[int]) -> set[int]:
    for pid in jobs:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGTERM)
    return jobs


def _jobs(session: Mapping[int, int], leader: int) -> set[int]:
    """Of the processes of a session, those that its leader started, or would have been started by it."""
    below = set(session) - {leader}
    return {pid for pid in below if session[pid] not in below}


def _session(leader: int) -> Mapping[int, int]:
    """The living processes of a session -> their parents; its number is used for nothing else while one lives."""
    found: dict[int, int] = {}
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with suppress(OSError):  # it has ended
                state, parent, _, session = (folder / "stat").read_bytes().rpartition(b")")[2].split()[:4]
                if int(session) == leader and state not in (b"Z", b"X"):
                    found[int(folder.name)] = int(parent)
    return found


def _said(place: CohortPlace, code: int) -> str:
    """The last lines of the log that a person can use."""
    with suppress(OSError):
        lines = read_file(place.engine_log)[-_SAID_BYTES:].decode("utf-8", "replace").splitlines()
        told = [_told(line.strip()) for line in lines if line.strip() and not _NOISE.fullmatch(line.strip())]
        kept = list(dict.fromkeys(reversed(told)))[:_SAID_LINES]
        if kept:
            return "\n".join(reversed(kept))
    return f"It was ended by signal {-code}." if code < 0 else f"It ended with exit code {code} and said nothing."


def _told(line: str) -> str:
    failed = _FAILED_JOB.fullmatch(line)
    if failed:
        what = f"Batch {failed['batch']}" if failed["batch"] else "The summary"
        line = f"{what} {failed['how']}{failed['rest']}"
    return printable(line)[:_SAID_SIGNS]
