"""What the commands share: the program itself, options, and the only functions that print."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pipeline.errors import ExitCode

if TYPE_CHECKING:
    from pipeline.engine.stage import Stage

EXIT_CODES = """Exit codes: 0 PASS, 10 REJECTED (the case cannot be used), 11 REVIEW (look before you use it),
20 wrong settings or usage, 30 the machine (disk, permission, renderer), 70 an error in the program, 130 interrupted."""

app = typer.Typer(
    name="ct2lut",
    help="From the label map of a knee to the look-up table that animates it. Research use - not for diagnosis.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

CaseId = Annotated[str, typer.Argument(metavar="ID", help="The case: the name of its folder below --cases.")]
Cases = Annotated[Path, typer.Option("--cases", help="Folder with one folder a case; never written to.")]
Results = Annotated[Path, typer.Option("--results", help="Folder for the results, one folder a case.")]
Protocol = Annotated[str, typer.Option("--protocol", help="Name of a protocol, or a .yaml file of your own.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="STAGE.KEY=VALUE", help="Change one setting; may be given several times."),
]
Jobs = Annotated[int, typer.Option("--jobs", min=0, help="Processes to use; 0 means one for each core.")]

DEFAULT_CASES = Path("cases")
DEFAULT_RESULTS = Path("results")
DEFAULT_PROTOCOL = "clinical"


def flow() -> tuple[Stage, ...]:
    """The stages, imported when a command needs them; a test gives others."""
    from pipeline.flow import FLOW

    return FLOW


def say(*lines: str) -> None:
    """Show lines."""
    for line in lines:
        write(f"{line}\n")


def write(text: str) -> None:
    """Show text as it is."""
    print(text, end="", flush=True)


def complain(problem: str, action: str, code: ExitCode) -> int:
    """Two lines on standard error; the exit code."""
    print(f"{problem}\n{action}", file=sys.stderr)
    return code
