/** Turns by `angle`, then moves by (x, y). */
export interface Rigid {
  angle: number;
  x: number;
  y: number;
}

export function apply({angle, x, y}: Rigid, px: number, py: number):
    [number, number] {
  const cosine = Math.cos(angle);
  const sine = Math.sin(angle);
  return [x + cosine * px - sine * py, y + sine * px + cosine * py];
}

/** The motion that brings `from` nearest to `to`, point by point, in least
 * squares. Points are x0, y0, x1, y1, ... */
export function fit(from: ArrayLike<number>, to: ArrayLike<number>): Rigid {
  const count = from.length / 2;
  if (count === 0) return {angle: 0, x: 0, y: 0};
  let fx = 0, fy = 0, tx = 0, ty = 0;
  for (let i = 0; i < from.length; i += 2) {
    fx += from[i] / count;
    fy += from[i + 1] / count;
    tx += to[i] / count;
    ty += to[i + 1] / count;
  }
  let dot = 0, cross = 0;
  for (let i = 0; i < from.length; i += 2) {
    const ax = from[i] - fx, ay = from[i + 1] - fy;
    const bx = to[i] - tx, by = to[i + 1] - ty;
    dot += ax * bx + ay * by;
    cross += ax * by - ay * bx;
  }
  const angle = Math.atan2(cross, dot);
  const [rx, ry] = apply({angle, x: 0, y: 0}, fx, fy);
  return {angle, x: tx - rx, y: ty - ry};
}
