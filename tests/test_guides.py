"""The program text of the guides does what they say: it is taken from the page and run."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipeline.exports import export_files
from tests.exports.readers import Glb
from tests.exports.test_agreement import player, source

CHECKOUT = Path(__file__).parents[1]
VIEWER = CHECKOUT / "pipeline" / "report" / "viewer"
NODE = shutil.which("node")

#: Ours has no loader of glTF: names, tree and facts of the file are what the guide uses of it.
LOADER = """
import { readFileSync } from "node:fs";
import { Group } from "./three.mjs";
export class GLTFLoader {
  async loadAsync(name) {
    const bytes = readFileSync(name);
    const file = JSON.parse(bytes.subarray(20, 20 + bytes.readUInt32LE(12)));
    const nodes = file.nodes.map((node) => Object.assign(new Group(), { name: node.name }));
    file.nodes.forEach((node, i) => (node.children ?? []).forEach((child) => nodes[i].add(nodes[child])));
    const scene = Object.assign(new Group(), { userData: file.scenes[0].extras });
    file.scenes[0].nodes.forEach((i) => scene.add(nodes[i]));
    return { scene };
  }
}
globalThis.fetch = async (name) => ({ json: async () => JSON.parse(readFileSync(name)) });
"""
THREE = """
import { readFileSync } from "node:fs";
import vm from "node:vm";
vm.runInThisContext(readFileSync("three.min.js", "utf8"));
export const { Group, Matrix4, Vector3 } = THREE;
"""
REPORT = """
console.log(JSON.stringify(tibia.matrix.clone().transpose().elements));
"""


@pytest.mark.skipif(NODE is None, reason="node is not installed: the JavaScript of the guide is not tried")
@pytest.mark.parametrize("side", ["right", "left"])
def test_the_javascript_of_the_vr_guide(side: str, tmp_path: Path) -> None:
    """It puts the tibia where the Python player does, and its own check of the check poses holds."""
    files = export_files(source(side))
    for name in ("knee.glb", "lut.json"):
        (tmp_path / name).write_bytes(files[name])
    shutil.copy(VIEWER / "three.min.js", tmp_path)
    shutil.copy(VIEWER / "player.js", tmp_path / "player.mjs")
    (tmp_path / "three.mjs").write_text(THREE)
    (tmp_path / "loader.mjs").write_text(LOADER)
    (tmp_path / "guide.mjs").write_text(_program() + REPORT)
    assert NODE
    done = subprocess.run([NODE, "guide.mjs"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    model_from_scan = np.array(Glb(files["knee.glb"]).document["scenes"][0]["extras"]["gltf_m_from_lps_mm"])
    expected = model_from_scan @ player(side).pose(60.0, 2.0) @ np.linalg.inv(model_from_scan)
    np.testing.assert_allclose(np.reshape(json.loads(done.stdout), (4, 4)), expected, rtol=0, atol=1e-9)


def _program() -> str:
    blocks = re.findall(r"```js\n(.*?)```", (CHECKOUT / "docs" / "guide-vr.md").read_text(), re.DOTALL)
    assert len(blocks) == 2
    places = {
        '"three/addons/loaders/GLTFLoader.js"': '"./loader.mjs"',
        '"three"': '"./three.mjs"',
        "player.js": "player.mjs",
    }
    text = "".join(blocks)
    for written, here in places.items():
        assert written in text
        text = text.replace(written, here)
    return text
