"""``ct2lut doctor``: whether this machine has what a run needs, one line a check, each with what to do.

A check that crashes is a failed check: nothing here raises. What a check finds names no path but what the user typed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from pipeline import __version__
from pipeline.commands import doctor_machine, doctor_program, doctor_storage
from pipeline.commands.doctor_answer import Answer, State
from pipeline.commands.doctor_program import SETUP
from pipeline.engine.runlog import printable
from pipeline.engine.storage_faults import environment_fault
from pipeline.errors import ExitCode, PipelineError

Probe = Callable[[], Answer]

#: Of the program and the machine, in the order they are told; the names are keys for monitoring and stay as they are.
PROBES: Mapping[str, Probe] = {
    "python": doctor_program.interpreter,
    "packages": doctor_program.packages,
    "solver": doctor_program.solver,
    "renderer": doctor_program.renderer,
    "pdf": doctor_program.text,
    "sealing": doctor_program.sealing,
    "memory": doctor_machine.memory,
    "processors": doctor_machine.processors,
    "limits": doctor_machine.limits,
    "temporary": doctor_machine.temporary,
}
_WIDTH = max(map(len, PROBES))


@dataclass(frozen=True)
class Check:
    """One line.

    Attributes
    ----------
    name : str
        Stable.
    state : State
    found, action : str
        As in Answer.
    """

    name: str
    state: State
    found: str
    action: str


def examine(results: Path, more: Mapping[str, Probe] = {}) -> Iterator[Check]:
    """Every check, as soon as it is done: some take seconds.

    Parameters
    ----------
    results : Path
        Folder for results; never made, and nothing is left in it.
    more : mapping of str to probe
        Of what a command may not know; told between those of the machine and those of the folder.
    """
    for name, probe in {**PROBES, **more}.items():
        yield checked(name, probe)
    yield checked("disk", partial(doctor_storage.room, results))
    keeping = checked("results", partial(doctor_storage.keeping, results))
    yield keeping
    usable = keeping.state is not State.FAIL
    yield checked("locks", partial(doctor_storage.locks, results) if usable else _untried)
    yield checked("clock", partial(doctor_storage.clock, results) if usable else _untried)


def checked(name: str, probe: Probe) -> Check:
    """What a probe answers; its crash is an answer too."""
    answer = _answer(probe)
    return Check(name, answer.state, answer.found, answer.action)


def _answer(probe: Probe) -> Answer:
    try:
        return probe()
    except PipelineError as error:
        return Answer(error.problem, State.FAIL, error.action)
    except ImportError as error:
        return Answer(f"a Python package cannot be used: {error.name or 'unknown'}", State.FAIL, SETUP)
    except OSError as error:
        fault = environment_fault(error, "The check")
        return Answer(fault.problem, State.FAIL, fault.action)
    except Exception as error:  # noqa: BLE001 -- a doctor who faints helps nobody; the text may name paths
        return Answer(f"the check itself failed ({type(error).__name__})", State.FAIL, "Please report this line.")


def _untried() -> Answer:
    return Answer("not tried: the results folder cannot be used", State.LOOK, "Mend what 'results' says first.")


def lines(check: Check) -> list[str]:
    """One line, and a second with what to do."""
    first = f"{check.name:<{_WIDTH}}  {check.state:<4}  {printable(check.found)}"
    return [first, f"{'':<{_WIDTH + 8}}-> {printable(check.action)}"] if check.action else [first]


def closing(checks: Sequence[Check]) -> str:
    """The last line: what it comes to."""
    failed, looks = ([check.name for check in checks if check.state is state] for state in (State.FAIL, State.LOOK))
    if failed:
        return f"This machine is not ready: mend {', '.join(failed)}."
    return f"This machine is ready; look at {', '.join(looks)}." if looks else "This machine is ready."


def json_line(checks: Sequence[Check]) -> str:
    """All of it as one JSON object, for monitoring."""
    whole = {"ok": exit_code(checks) == ExitCode.PASS, "checks": [asdict(check) for check in checks]}
    return json.dumps(whole | {"version": __version__})


def exit_code(checks: Sequence[Check]) -> ExitCode:
    """30 where a check failed, else 0."""
    return ExitCode.ENVIRONMENT if any(check.state is State.FAIL for check in checks) else ExitCode.PASS
