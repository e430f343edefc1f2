// Chi-square quantile of 2 degrees of freedom at 0.95: -2 ln 0.05.
const SQUARED_RADIUS_95 = -2 * Math.log(0.05);
const CORNERS = 36;

/** The half axes of the ellipse that holds 95 % of a Gaussian in the plane, in
 * metres, and the direction of the longer one, in radians. */
export function ellipse95(xx: number, xy: number, yy: number):
    {long: number, short: number, direction: number} {
  const mean = (xx + yy) / 2;
  const spread = Math.hypot((xx - yy) / 2, xy);
  return {
    long: Math.sqrt(SQUARED_RADIUS_95 * Math.max(0, mean + spread)),
    short: Math.sqrt(SQUARED_RADIUS_95 * Math.max(0, mean - spread)),
    direction: Math.atan2(2 * xy, xx - yy) / 2,
  };
}

/** Appends the outline as segments x0, y0, x1, y1. */
export function addEllipse(segments: number[], x: number, y: number,
                           {long, short, direction}:
                               ReturnType<typeof ellipse95>): void {
  const cosine = Math.cos(direction);
  const sine = Math.sin(direction);
  const corner = (i: number): [number, number] => {
    const angle = i * 2 * Math.PI / CORNERS;
    const u = long * Math.cos(angle);
    const v = short * Math.sin(angle);
    return [x + cosine * u - sine * v, y + sine * u + cosine * v];
  };
  for (let i = 0; i < CORNERS; ++i) {
    segments.push(...corner(i), ...corner(i + 1));
  }
}
