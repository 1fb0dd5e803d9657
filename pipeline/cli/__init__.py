"""The command line: the only place that prints or exits.

Heavy libraries are imported inside the commands that need them, so that help and a run with nothing to do are quick.
"""

from __future__ import annotations

import signal
import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, cast

import typer

from pipeline import __version__
from pipeline.cli import case, cohort, shared
from pipeline.cli.shared import EXIT_CODES, app, complain
from pipeline.errors import ExitCode, PipelineError

__all__ = ["EXIT_CODES", "app", "case", "cohort", "execute", "main", "shared"]


def main() -> None:
    """Entry point of the program ``ct2lut``."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    sys.exit(execute(sys.argv[1:]))


def execute(arguments: Sequence[str]) -> int:
    """Run one command; the exit code is returned and every failure is two lines on standard error."""
    try:
        code = _call(list(arguments)) or 0
    except PipelineError as error:
        return complain(f"{error.code}  {error.problem}", error.action, error.exit_code)
    except typer.TyperException as error:
        return complain(f"E-USE-01  {error.format_message()}", "ct2lut --help lists the commands.", ExitCode.USAGE)
    except OSError as error:
        problem = f"E-ENV-20  The operating system refused: {error.strerror or type(error).__name__}."
        return complain(problem, "Check the folders you named, their permissions and the disk.", ExitCode.ENVIRONMENT)
    except Exception as error:  # noqa: BLE001 -- the last line of defence: a bug is told in one line
        place = traceback.extract_tb(error.__traceback__)[-1]
        problem = f"E-BUG-01  The program failed: {type(error).__name__} in {place.name}, line {place.lineno}."
        return complain(problem, "Please report this line and the command you typed.", ExitCode.ERROR)
    if code == ExitCode.INTERRUPTED:
        return complain("Interrupted.", "The same command goes on where this one stopped.", ExitCode.INTERRUPTED)
    return int(code)


def _call(arguments: list[str]) -> int | None:
    if arguments[2:3] in (["participant"], ["group"]):
        from pipeline.cohort.bids.call import is_bids_call

        if is_bids_call(arguments, typer.main.get_group(app).commands):
            return cohort.run_bids_app(arguments)
    return cast("int | None", app(arguments or ["--help"], prog_name="ct2lut", standalone_mode=False))


@app.callback(invoke_without_command=True)
def _program(
    version: Annotated[bool, typer.Option("--version", help="Show the version and stop.")] = False,
) -> None:
    if version:
        print(f"ct2lut {__version__}")
        raise typer.Exit
