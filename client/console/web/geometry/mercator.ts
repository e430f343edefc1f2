const EARTH_RADIUS_METERS = 6378137;
const RADIANS = Math.PI / 180;

/** Places WGS84 positions on one map: Mercator's, scaled so that a metre is a
 * metre at the reference latitude. */
export function mercator(latitude: number, longitude: number,
                         reference: {latitude: number, longitude: number}):
    [number, number] {
  const scale = EARTH_RADIUS_METERS * Math.cos(reference.latitude * RADIANS);
  const height = (degrees: number) =>
      Math.asinh(Math.tan(Math.max(-89, Math.min(89, degrees)) * RADIANS));
  return [
    scale * (longitude - reference.longitude) * RADIANS,
    scale * (height(latitude) - height(reference.latitude)),
  ];
}
