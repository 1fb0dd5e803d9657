"""The exported files before the programs they are for: Khronos' glTF validator and OpenSim itself.

Neither is a dependency of this project. Name them to run these tests::

    npm install --prefix FOLDER gltf-validator          CT2LUT_NODE_MODULES=FOLDER/node_modules
    python3 -m venv VENV; VENV/bin/pip install opensim  CT2LUT_OPENSIM_PYTHON=VENV/bin/python
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.exports import export_files
from tests.exports.readers import parent_from_child
from tests.exports.test_agreement import SIDES, source

NODE_MODULES = os.environ.get("CT2LUT_NODE_MODULES", "")
OPENSIM_PYTHON = os.environ.get("CT2LUT_OPENSIM_PYTHON", "")
ATTITUDES = np.radians(np.random.default_rng(5).uniform([0.0, -4.0], [60.0, 2.5], (50, 2))).tolist()

_VALIDATE = """
const fs = require("fs"), validator = require("gltf-validator");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))
  .then(report => console.log(JSON.stringify({...report.issues, animations: report.info.animationCount})));
"""

_EVALUATE = """
import json, sys
import opensim

file, side, attitudes = json.load(sys.stdin)
model = opensim.Model(file)
state = model.initSystem()
femur, tibia = (model.getBodySet().get(f"{name}_{side}") for name in ("femur", "tibia"))
flexion, varus = (model.getCoordinateSet().get(f"knee_{name}_{side}") for name in ("flexion", "varus"))
poses = []
for attitude in attitudes:
    flexion.setValue(state, attitude[0])
    varus.setValue(state, attitude[1])
    model.realizePosition(state)
    pose = tibia.findTransformBetween(state, femur)
    poses.append([[*(pose.R().get(i, j) for j in range(3)), pose.T().get(i)] for i in range(3)])
flexion.setValue(state, 9.0)
print("RESULT", json.dumps({"poses": poses, "clamped": [flexion.getValue(state), flexion.getRangeMax()]}))
"""


def written(side: str, folder: Path) -> None:
    for name, data in export_files(source(side), ["glb", "osim"]).items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)


@SIDES
@pytest.mark.skipif(not (NODE_MODULES and shutil.which("node")), reason="needs node and CT2LUT_NODE_MODULES")
def test_the_validator_of_gltf_finds_nothing(side: str, tmp_path: Path) -> None:
    written(side, tmp_path)
    command = ["node", "-e", _VALIDATE, str(tmp_path / "knee.glb")]
    environment = {**os.environ, "NODE_PATH": str(Path(NODE_MODULES).resolve())}
    answer = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    report: dict[str, Any] = json.loads(answer.stdout)
    assert report["messages"] == []
    assert (report["numErrors"], report["numWarnings"], report["animations"]) == (0, 0, 4)


@SIDES
@pytest.mark.skipif(not OPENSIM_PYTHON, reason="needs CT2LUT_OPENSIM_PYTHON")
def test_opensim_loads_the_joint_without_a_word_and_moves_it_as_our_evaluator(side: str, tmp_path: Path) -> None:
    written(side, tmp_path)
    file = tmp_path / "opensim" / "joint.osim"
    answer = subprocess.run(
        [str(Path(OPENSIM_PYTHON).absolute()), "-c", _EVALUATE],
        input=json.dumps([str(file), side[0], ATTITUDES]),
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    assert "warning" not in (answer.stdout + answer.stderr).lower()
    result = json.loads(answer.stdout.partition("RESULT")[2])
    assert result["clamped"][0] == result["clamped"][1]
    for (flexion, varus), pose in zip(ATTITUDES, result["poses"], strict=True):
        values = {f"knee_flexion_{side[0]}": flexion, f"knee_varus_{side[0]}": varus}
        np.testing.assert_allclose(pose, parent_from_child(file.read_bytes(), values)[:3], rtol=0, atol=1e-9)
