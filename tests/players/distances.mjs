// node distances.mjs contact.js: reads {mesh, reach, points} as JSON, prints the distances (null beyond the reach)
import { readFileSync } from "node:fs";

const script = readFileSync(process.argv[2]).toString("base64");
const { Nearness } = await import(`data:text/javascript;base64,${script}`);
const { meshes, reach, points } = JSON.parse(readFileSync(0, "utf8"));
const nearness = new Nearness(meshes, reach);
console.log(JSON.stringify(points.map((point) => nearness.distance(...point))));
