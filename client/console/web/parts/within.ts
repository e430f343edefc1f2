import type {Doubt} from '../data/recordings.js';
import {ellipse95} from '../geometry/ellipse.js';
import {fixed, length} from './format.js';

/** Quantile of a Gaussian within whose deviations 95 % lie. */
const DEVIATIONS_95 = 1.96;

/** How near a recording is to where it is drawn, in 95 of 100 cases, as claimed;
 * '' in the map's own frame, and where it is not placed. */
export function withinText({doubt}: {doubt: Doubt|undefined}): string {
  if (!doubt) return '';
  const {long} = ellipse95(...doubt.covariance);
  const degrees = DEVIATIONS_95 * doubt.headingDeviation * 180 / Math.PI;
  return `to within ${length(long)}, ${
      degrees >= 180 ? 'any heading' : `${fixed(degrees, 1)}°`}`;
}
