/** How near points come to triangles, for colours: exact within a reach, and quick because far triangles are not asked. */
export class Nearness {
  /**
   * @param {{points: Float32Array, corners: ArrayLike<number>}[]} meshes of one space, mm
   * @param {number} reach mm; nothing is known beyond it
   */
  constructor(meshes, reach) {
    this.reach = reach;
    this.cells = new Map();
    this.triangles = Float64Array.from(meshes.flatMap(triangleRows));
    for (let start = 0; start < this.triangles.length; start += 9) this._enter(start);
  }

  /** Distance of a point to the nearest triangle; Infinity beyond the reach. */
  distance(x, y, z) {
    const [i, j, k] = [x, y, z].map((value) => Math.floor(value / this.reach));
    let least = this.reach ** 2;
    let near = false;
    for (const start of this.cells.get(cellName(i, j, k)) ?? []) {
      const square = squareDistance(this.triangles, start, x, y, z);
      if (square <= least) [least, near] = [square, true];
    }
    return near ? Math.sqrt(least) : Infinity;
  }

  /** Into every cell from which the triangle may be within reach. */
  _enter(start) {
    const t = this.triangles;
    const ranges = [0, 1, 2].map((axis) => {
      const a = t[start + axis];
      const ends = [a, a + t[start + 3 + axis], a + t[start + 6 + axis]];
      const cell = (value) => Math.floor(value / this.reach);
      return [cell(Math.min(...ends) - this.reach), cell(Math.max(...ends) + this.reach)];
    });
    for (let i = ranges[0][0]; i <= ranges[0][1]; i++) {
      for (let j = ranges[1][0]; j <= ranges[1][1]; j++) {
        for (let k = ranges[2][0]; k <= ranges[2][1]; k++) {
          const name = cellName(i, j, k);
          const cell = this.cells.get(name);
          if (cell) cell.push(start);
          else this.cells.set(name, [start]);
        }
      }
    }
  }
}

/** One number for a cell; 2^16 cells along each axis are more than a scan has. */
function cellName(i, j, k) {
  return ((i + 32768) * 65536 + (j + 32768)) * 65536 + (k + 32768);
}

/** First corner and the two edges from it, nine numbers a triangle. */
function triangleRows({ points, corners }) {
  const rows = [];
  for (let c = 0; c < corners.length; c += 3) {
    const [a, b, d] = [0, 1, 2].map((k) => 3 * corners[c + k]);
    for (const [to, from] of [[a, null], [b, a], [d, a]]) {
      for (let axis = 0; axis < 3; axis++) rows.push(points[to + axis] - (from === null ? 0 : points[from + axis]));
    }
  }
  return rows;
}

/** Of a point to a triangle (Ericson, Real-Time Collision Detection, 5.1.5): the nearest is a + v ab + w ac. */
function squareDistance(t, s, x, y, z) {
  const [px, py, pz] = [x - t[s], y - t[s + 1], z - t[s + 2]];
  const [bx, by, bz, cx, cy, cz] = [t[s + 3], t[s + 4], t[s + 5], t[s + 6], t[s + 7], t[s + 8]];
  const across = bx * cx + by * cy + bz * cz;
  const d1 = bx * px + by * py + bz * pz;
  const d2 = cx * px + cy * py + cz * pz;
  const [d3, d4] = [d1 - (bx * bx + by * by + bz * bz), d2 - across];
  const [d5, d6] = [d1 - across, d2 - (cx * cx + cy * cy + cz * cz)];
  const [va, vb, vc] = [d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2];
  let [v, w] = [0, 0];
  if (d1 <= 0 && d2 <= 0) [v, w] = [0, 0];
  else if (d3 >= 0 && d4 <= d3) [v, w] = [1, 0];
  else if (vc <= 0 && d1 >= 0 && d3 <= 0) [v, w] = [d1 / (d1 - d3), 0];
  else if (d6 >= 0 && d5 <= d6) [v, w] = [0, 1];
  else if (vb <= 0 && d2 >= 0 && d6 <= 0) [v, w] = [0, d2 / (d2 - d6)];
  else if (va <= 0 && d4 >= d3 && d5 >= d6) {
    w = (d4 - d3) / (d4 - d3 + d5 - d6);
    v = 1 - w;
  } else [v, w] = [vb / (va + vb + vc), vc / (va + vb + vc)];
  return (px - v * bx - w * cx) ** 2 + (py - v * by - w * cy) ** 2 + (pz - v * bz - w * cz) ** 2;
}
