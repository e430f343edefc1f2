// The metrics of revisitd, which the console's server part passes on.
import type {Scrape} from '../../server/metrics.js';
import {credentials} from './client.js';
import {Reading} from './readings.js';

/** The console's answer where there are no metrics for this caller. */
export class NoMetrics extends Error {
  constructor(readonly status: number, message: string) {
    super(message);
  }
}

/** Throws NoMetrics where the console refuses or has none. */
export async function readMetrics(): Promise<Reading> {
  const answer = await fetch('/metrics.json', {headers: credentials()});
  if (!answer.ok) {
    const {message} = await answer.json() as {message: string};
    throw new NoMetrics(answer.status, message);
  }
  return new Reading(await answer.json() as Scrape);
}
