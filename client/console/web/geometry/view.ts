/** A rectangle, in metres. */
export interface Box {
  left: number;
  bottom: number;
  right: number;
  top: number;
}

/** The part of the plane that a map shows: its centre, and how much a pixel
 * is. */
export interface View {
  x: number;
  y: number;
  metersPerPixel: number;
  /** Size of the map, in pixels. */
  width: number;
  height: number;
}

export function boxOf(view: View): Box {
  const halfWidth = view.width / 2 * view.metersPerPixel;
  const halfHeight = view.height / 2 * view.metersPerPixel;
  return {
    left: view.x - halfWidth,
    bottom: view.y - halfHeight,
    right: view.x + halfWidth,
    top: view.y + halfHeight,
  };
}

/** The box around points x0, y0, x1, y1, ...; undefined if there are none. */
export function boxAround(points: ArrayLike<number>): Box|undefined {
  if (points.length === 0) return undefined;
  const box = {left: Infinity, bottom: Infinity, right: -Infinity,
               top: -Infinity};
  for (let i = 0; i < points.length; i += 2) {
    box.left = Math.min(box.left, points[i]);
    box.right = Math.max(box.right, points[i]);
    box.bottom = Math.min(box.bottom, points[i + 1]);
    box.top = Math.max(box.top, points[i + 1]);
  }
  return box;
}

/** The view that shows all of a box. */
export function viewOf(box: Box, width: number, height: number): View {
  const marginPixels = Math.min(40, width / 8, height / 8);
  const metersPerPixel = Math.max(
      (box.right - box.left) / (width - 2 * marginPixels),
      (box.top - box.bottom) / (height - 2 * marginPixels), 0.02);
  return {
    x: (box.left + box.right) / 2,
    y: (box.bottom + box.top) / 2,
    metersPerPixel,
    width,
    height,
  };
}
