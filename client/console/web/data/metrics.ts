// The metrics of the servers, which the console's server part passes on.
import type {MetricsAnswer} from '../../server/metrics.js';
import {credentials} from './client.js';

/** The console's answer where there are no metrics for this caller. */
export class NoMetrics extends Error {
  constructor(readonly status: number, message: string) {
    super(message);
  }
}

/** Throws NoMetrics where the console refuses or has none. */
export async function readMetrics(): Promise<MetricsAnswer> {
  const answer = await fetch('/metrics.json', {headers: credentials()});
  if (!answer.ok) {
    const {message} = await answer.json() as {message: string};
    throw new NoMetrics(answer.status, message);
  }
  return await answer.json() as MetricsAnswer;
}
