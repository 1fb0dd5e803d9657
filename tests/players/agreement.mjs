// node agreement.mjs player.js vectors.json: holds the player to the vectors, prints how many and the largest difference
import { readFileSync } from "node:fs";

const [script, file] = process.argv.slice(2);
const { Lut } = await import(`data:text/javascript;base64,${readFileSync(script).toString("base64")}`);
const { data, cases } = JSON.parse(readFileSync(file, "utf8"));
const lut = new Lut(data);
const counts = { posed: 0, nothing: 0, refused: 0 };
let worst = 0;

function answer({ flexion_deg, varus_deg, outside }) {
  const at = [Number(flexion_deg), Number(varus_deg), outside];
  try {
    const used = lut.coordinates(...at);
    return { motion: lut.pose(...at), used: [used.flexion_deg, used.varus_deg] };
  } catch (error) {
    if (!(error instanceof RangeError)) throw error;
    return { error: error.message };
  }
}

function demand(holds, one, got) {
  if (!holds) throw new Error(`expected ${JSON.stringify(one)}, got ${JSON.stringify(got)}`);
}

for (const one of cases) {
  const got = answer(one);
  if (one.error !== null) {
    counts.refused++;
    demand(got.error === one.error, one, got);
  } else if (one.moved_from_scan === null) {
    counts.nothing++;
    demand(got.motion?.length === 16 && got.motion.every(Number.isNaN), one, got);
  } else {
    counts.posed++;
    demand(!got.error && got.motion.length === 16, one, got);
    const pairs = [...one.moved_from_scan.map((value, k) => [value, got.motion[k]]), ...one.used.map((value, k) => [value, got.used[k]])];
    for (const [wanted, found] of pairs) {
      demand(Number.isFinite(found), one, got);
      worst = Math.max(worst, Math.abs(wanted - found));
    }
  }
}
console.log(JSON.stringify({ ...counts, worst }));
