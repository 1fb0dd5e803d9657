"""What decides that batches run again: version, code and settings. Only a hint; the cache of each case decides."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

from pipeline import __version__
from pipeline.cohort.model import CohortRequest
from pipeline.config import load_settings
from pipeline.engine.code_digest import code_of, package_versions
from pipeline.engine.records import canonical_json
from pipeline.engine.stage import Stage


def plan_key(request: CohortRequest, flow: Sequence[Stage]) -> str:
    """SHA-256 over all but the cases that decides the results of a cohort.

    Raises
    ------
    ConfigError
        When the protocol or a setting is wrong: before any case is begun.
    """
    nobody = Path(os.devnull) / "no-case"
    settings = load_settings(flow, nobody, request.protocol, request.overrides)
    decides = {
        "version": __version__,
        "code": {stage.name: code_of(stage).meaning for stage in flow},
        "packages": package_versions(),
        "settings": {name: params.model_dump(mode="json") for name, params in settings.items()},
        "limits": [request.limits.memory_mb, request.limits.time_s],
    }
    return hashlib.sha256(canonical_json(decides)).hexdigest()
