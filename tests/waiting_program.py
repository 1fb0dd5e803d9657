"""The command line with a flow whose only stage says that it waits, and waits for a minute."""

from __future__ import annotations

import dataclasses
import sys
import time
from pathlib import Path

from pipeline import cli, config
from pipeline.engine.stage import Findings, Inputs, Outputs, StrictParams
from tests.toy_flow import INTAKE, write_toy_configs


def wait(reads: Inputs, params: StrictParams, out: Outputs) -> Findings:
    sys.stdout.write("waiting\n")
    sys.stdout.flush()
    time.sleep(60)
    return ()


if __name__ == "__main__":
    # the code of a stage is found by the name of its module, and that of a program is __main__
    from tests.waiting_program import wait as imported_wait

    config.CONFIGS = write_toy_configs(Path("configs"))
    cli.shared.flow = lambda: (dataclasses.replace(INTAKE, run=imported_wait),)
    cli.main()
