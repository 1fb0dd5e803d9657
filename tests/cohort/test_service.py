"""The systemd unit of the watch: it says what the program understands, and systemd understands it."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
from typer.main import get_command

from pipeline.cli.shared import app
from tests.source_code import CHECKOUT

UNIT = CHECKOUT / "packaging" / "ct2lut.service"
ANALYZE = shutil.which("systemd-analyze")


@pytest.fixture(scope="module")
def service() -> Mapping[str, str]:
    found: dict[str, str] = {}
    for line in UNIT.read_text().partition("[Service]")[2].partition("[Install]")[0].splitlines():
        name, mark, value = line.partition("=")
        if mark and not line.startswith("#"):
            found[name] = f"{found[name]}\n{value}" if name in found else value
    return found


def test_the_command_is_one_that_the_program_has(service: Mapping[str, str]) -> None:
    program, command, *options = shlex.split(service["ExecStart"])
    assert program.endswith("/bin/ct2lut")
    known = {name for option in get_command(app).commands[command].params for name in option.opts}  # type: ignore[attr-defined]
    assert set(options[::2]) <= known
    given = dict(zip(options[::2], options[1::2], strict=True))
    assert service["ReadWritePaths"] == given["--results"]
    assert service["ReadOnlyPaths"] == given["--cases"]


def test_the_program_can_still_seal_itself_and_make_code(service: Mapping[str, str]) -> None:
    allowed = service["SystemCallFilter"].split()
    assert {"landlock_create_ruleset", "landlock_add_rule", "landlock_restrict_self"} <= set(allowed)
    assert "MemoryDenyWriteExecute" not in service
    assert service["NoNewPrivileges"] == "yes"


@pytest.mark.skipif(ANALYZE is None, reason="systemd-analyze is not installed: the unit is not read by systemd")
def test_systemd_understands_the_unit(service: Mapping[str, str], tmp_path: Path) -> None:
    assert ANALYZE
    unit = tmp_path / UNIT.name
    unit.write_text(UNIT.read_text().replace(service["ExecStart"].split()[0], sys.executable))
    done = subprocess.run([ANALYZE, "verify", unit], capture_output=True, text=True, check=False)
    assert not [line for line in done.stderr.splitlines() if line.startswith(UNIT.name)]
    unit.write_text(unit.read_text().replace("KillMode=mixed", "KillMode=nonsense"))
    done = subprocess.run([ANALYZE, "verify", unit], capture_output=True, text=True, check=False)
    assert "nonsense" in done.stderr
