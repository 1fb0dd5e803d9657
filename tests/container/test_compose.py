"""What can be said of compose.yaml without an engine: each service is sealed, and says what the program understands."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from pipeline.cli import app
from pipeline.cohort.driver import LOCAL_PATIENCE_S
from pipeline.cohort.limited_process import GRACE_S

SERVICES: dict[str, dict[str, Any]] = yaml.safe_load(
    (Path(__file__).resolve().parents[2] / "compose.yaml").read_text(encoding="utf-8")
)["services"]


@pytest.mark.parametrize("name", SERVICES)
def test_every_service_has_everything_taken_away(name: str) -> None:
    service = SERVICES[name]
    assert (service["read_only"], service["network_mode"], service["tmpfs"]) == (True, "none", "/tmp")
    assert (service["cap_drop"], service["security_opt"]) == (["ALL"], ["no-new-privileges:true"])
    assert service["user"] == "${RUN_AS:-65532:65532}"
    assert service["volumes"] == ["./cases:/data/cases:ro", "./results:/data/results"]
    assert not {"privileged", "cap_add", "ports", "networks", "devices", "pid", "ipc"} & set(service)


@pytest.mark.parametrize("name", SERVICES)
def test_every_service_is_given_the_time_that_a_clean_end_takes(name: str) -> None:
    assert SERVICES[name]["init"] is True
    assert SERVICES[name]["stop_grace_period"] == "1m"
    assert LOCAL_PATIENCE_S + GRACE_S < 60


def test_the_server_alone_starts_by_itself() -> None:
    assert set(SERVICES) == {"ct2lut", "cohort", "watch"}
    assert [name for name, service in SERVICES.items() if "profiles" not in service] == ["watch"]
    assert [name for name, service in SERVICES.items() if "restart" in service] == ["watch"]


@pytest.mark.parametrize("name", ["cohort", "watch"])
def test_a_service_says_what_the_program_understands(name: str) -> None:
    first, *words = SERVICES[name]["command"]
    assert first == name
    given = typer.main.get_group(app).commands[name].make_context(name, list(words)).params
    assert (str(given["cases"]), str(given["results"])) == ("/data/cases", "/data/results")
