"""What every test of the engine shares."""

from __future__ import annotations

import os

import pytest


@pytest.fixture(autouse=True)
def quick_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """No waiting for the disk: a killed process leaves the page cache whole, and power cuts are not tested here."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
