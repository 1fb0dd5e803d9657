"""What ``ct2lut doctor`` asks of the workflow engine."""

from __future__ import annotations

import os
import re
import subprocess
import tempfile
from pathlib import Path

from pipeline.cohort.driver import PROGRAM_VARIABLE, find_engine
from pipeline.commands.doctor_answer import Answer, State
from pipeline.errors import EnvironmentFault

#: The engine needs seconds to say its version; one that needs this long hangs.
ANSWER_S = 120.0


def engine_answer() -> Answer:
    """Which engine a cohort would use, and whether it answers; none is well, for a single case needs none."""
    try:
        program = find_engine("workstation", 0).snakemake
    except EnvironmentFault as fault:
        if os.environ.get(PROGRAM_VARIABLE):
            return Answer(fault.problem, State.LOOK, fault.action)
        return Answer("not installed; a single case does not need it (make setup-cohort)")
    folder = program.parent.parent.name
    place = folder if folder.endswith("-cohort") else "your own"
    said = _asked_for_version(program)
    if re.fullmatch(r"\d+(\.\w+)+", said):
        return Answer(f"snakemake {said} ({place})")
    action = f"Type: rm -r .venv-cohort; make setup-cohort. Or name another: export {PROGRAM_VARIABLE}=FILE"
    return Answer(f"snakemake ({place}) is there and does not work: {said}", State.LOOK, action)


def _asked_for_version(program: Path) -> str:
    """What it answers, or how it failed; without a home it would leave its caches where it stands."""
    with tempfile.TemporaryDirectory(prefix="ct2lut-doctor-") as own:
        try:
            done = subprocess.run(  # noqa: S603 -- the program that a cohort would start
                [str(program), "--version"],
                env=os.environ | {"HOME": own, "XDG_CACHE_HOME": own},
                cwd=own,
                stdin=subprocess.DEVNULL,
                capture_output=True,
                timeout=ANSWER_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return f"no answer after {ANSWER_S:g} s"
        except OSError as error:
            return f"it cannot be started ({type(error).__name__})"
    return done.stdout[:40].decode("utf-8", "replace").strip() if done.returncode == 0 else f"exit {done.returncode}"
