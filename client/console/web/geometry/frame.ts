// How the plane of a map, in metres, lies on the earth (WGS84).

export interface Place {
  /** Degrees. */
  latitude: number;
  longitude: number;
}

/** The plane of a map whose place on the earth is known. */
export interface Frame {
  /** Where it is at (0, 0), or near it. */
  origin: Place;
  /** East and north, in metres. */
  toMap(place: Place): [number, number];
  /** The way back, where a formula says it. */
  toEarth?(x: number, y: number): Place;
}

const RADIANS = Math.PI / 180;
/** Half the longer axis of the ellipsoid, and its squared eccentricity. */
const AXIS_METERS = 6378137;
const SQUARED_ECCENTRICITY = 0.00669437999014;
const METERS_PER_DEGREE = AXIS_METERS * RADIANS;
const MOST_LATITUDE = 89;
const STEPS = 12;

/** Height of a latitude on Mercator's map of an earth of radius 1. */
export function mercatorHeight(latitude: number): number {
  const bounded = Math.max(-MOST_LATITUDE, Math.min(MOST_LATITUDE, latitude));
  return Math.asinh(Math.tan(bounded * RADIANS));
}

/** Mercator's map, scaled so that a metre is a metre at the origin. */
export function mercatorFrame(origin: Place): Frame {
  const scale = AXIS_METERS * Math.cos(origin.latitude * RADIANS);
  const originHeight = mercatorHeight(origin.latitude);
  return {
    origin,
    toMap: ({latitude, longitude}) => [
      scale * (longitude - origin.longitude) * RADIANS,
      scale * (mercatorHeight(latitude) - originHeight),
    ],
    toEarth: (x, y) => ({
      latitude: Math.atan(Math.sinh(y / scale + originHeight)) / RADIANS,
      longitude: origin.longitude + x / scale / RADIANS,
    }),
  };
}

/** Metres from the centre of the earth, of a place so high above the
 * ellipsoid. */
function earthCentred({latitude, longitude}: Place, height: number):
    [number, number, number] {
  const [sine, cosine] = [Math.sin(latitude * RADIANS),
                          Math.cos(latitude * RADIANS)];
  const normal =
      AXIS_METERS / Math.sqrt(1 - SQUARED_ECCENTRICITY * sine * sine);
  return [
    (normal + height) * cosine * Math.cos(longitude * RADIANS),
    (normal + height) * cosine * Math.sin(longitude * RADIANS),
    (normal * (1 - SQUARED_ECCENTRICITY) + height) * sine,
  ];
}

/** The plane that touches the earth at the origin, whose height is that of all
 * places here: the frame in which the server has the paths of geodetic
 * vehicles, seen from above. */
export function tangentFrame(origin: Place, heightMeters: number): Frame {
  const [x0, y0, z0] = earthCentred(origin, heightMeters);
  const [sinLat, cosLat] = [Math.sin(origin.latitude * RADIANS),
                            Math.cos(origin.latitude * RADIANS)];
  const [sinLon, cosLon] = [Math.sin(origin.longitude * RADIANS),
                            Math.cos(origin.longitude * RADIANS)];
  return {
    origin,
    toMap: place => {
      const [x, y, z] = earthCentred(place, heightMeters);
      const [dx, dy, dz] = [x - x0, y - y0, z - z0];
      return [
        -sinLon * dx + cosLon * dy,
        -sinLat * (cosLon * dx + sinLon * dy) + cosLat * dz,
      ];
    },
  };
}

/** The place below a point of the map, which lies within 1000 km of the origin
 * where the frame has no formula: by steps that each are as long as the rest of
 * the way would be there. */
export function toEarth(frame: Frame, x: number, y: number): Place {
  if (frame.toEarth) return frame.toEarth(x, y);
  const place = {...frame.origin};
  for (let step = 0; step < STEPS; ++step) {
    const [px, py] = frame.toMap(place);
    const cosine = Math.max(0.02, Math.cos(place.latitude * RADIANS));
    place.latitude = Math.max(-MOST_LATITUDE, Math.min(
        MOST_LATITUDE, place.latitude + (y - py) / METERS_PER_DEGREE));
    place.longitude += (x - px) / (METERS_PER_DEGREE * cosine);
  }
  return place;
}
