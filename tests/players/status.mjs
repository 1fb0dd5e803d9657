// node status.mjs player.js: reads {data, attitudes} as JSON, prints the status of each attitude (null outside the grid)
import { readFileSync } from "node:fs";

const script = readFileSync(process.argv[2]).toString("base64");
const { Lut } = await import(`data:text/javascript;base64,${script}`);
const { data, attitudes } = JSON.parse(readFileSync(0, "utf8"));
const lut = new Lut(data);
console.log(JSON.stringify(attitudes.map((attitude) => lut.status(...attitude))));
