// The page keeps the servers' last readings, for rates, and a point of each curve a
// second, for as long as it is open.
import type {MetricsAnswer} from '../../server/metrics.js';
import type {ServerMetrics, Silence} from '../../server/scrape.js';
import {Interval, type Measures, quantile, type Quantile, Reading} from
    './readings.js';
import {Total} from './total.js';

/** Rates and quantiles are of the last so many milliseconds. */
const WINDOW_MILLISECONDS = 10_000;
const MOST_POINTS = 600;
const STREAMS = ['StreamPoses', 'RevisePoses', 'ExportPoseGraph'];

/** Histograms whose quantiles are drawn as curves, in this order. */
export const DRAWN_LATENCIES = [
  'revisit_ack_seconds', 'revisit_search_seconds', 'revisit_call_seconds',
];

/** The numbers of one moment that are drawn as curves; null if not known. */
export interface Point {
  /** Milliseconds since 1970. */
  time: number;
  streams: number|null;
  /** Each of these two a second. */
  calls: number|null;
  poses: number|null;
  queuedBytes: number|null;
  /** p50 and p99 of DRAWN_LATENCIES, in milliseconds. */
  latencies: Array<[number|null, number|null]>;
}

export interface ServerHistory {
  name: string;
  /** Readings of the last WINDOW_MILLISECONDS, all of one process. */
  readings: Reading[];
  /** From the first to the last of them; undefined without any. While the
   * server is silent it is as it was before. */
  interval: Interval|undefined;
  silence: Silence|undefined;
  points: Point[];
}

export interface History {
  /** In the order of the console's flags. */
  servers: ServerHistory[];
  /** Over all that answer; undefined if none does. */
  total: Total|undefined;
  totalPoints: Point[];
}

export const NO_HISTORY: History =
    {servers: [], total: undefined, totalPoints: []};

/** How many streams and unary calls are open. */
export function openOf(measures: Measures): {streams: number, calls: number} {
  const open = measures.by('revisit_calls_open', 'method');
  const all = [...open.values()].reduce((sum, value) => sum + value, 0);
  const streams = STREAMS.reduce(
      (sum, method) => sum + (open.get(method) ?? 0), 0);
  return {streams, calls: all - streams};
}

function milliseconds(found: Quantile|undefined): number|null {
  return found ? 1000 * found.value : null;
}

function pointOf(time: number, measures: Measures|undefined): Point {
  return {
    time,
    streams: measures ? openOf(measures).streams : null,
    calls: measures?.rate('revisit_calls_total') ?? null,
    poses: measures?.rate('revisit_poses_accepted_total') ?? null,
    queuedBytes: measures?.value('revisit_queued_bytes') ?? null,
    latencies: DRAWN_LATENCIES.map(
        name => measures ? [milliseconds(quantile(measures, name, 0.5)),
                            milliseconds(quantile(measures, name, 0.99))] :
                           [null, null]),
  };
}

function withPoint(points: Point[], point: Point): Point[] {
  return [...points, point].slice(-MOST_POINTS);
}

function isSameProcess(a: Reading, b: Reading): boolean {
  return a.value('process_start_time_seconds') ===
      b.value('process_start_time_seconds');
}

function serverAfter(before: ServerHistory, time: number,
                     {scrape, silence}: ServerMetrics): ServerHistory {
  if (silence) {
    return {...before, silence,
            points: withPoint(before.points, pointOf(time, undefined))};
  }
  const last = before.readings.at(-1);
  // A server that is slow to answer is told as it was known before.
  if (!scrape || scrape.time === last?.time) return {...before, silence};
  const now = new Reading(scrape);
  const readings = before.readings.filter(
      reading => now.time - reading.time <= WINDOW_MILLISECONDS &&
          reading.time < now.time && isSameProcess(reading, now));
  readings.push(now);
  const interval = new Interval(readings[0], now);
  return {...before, readings, interval, silence,
          points: withPoint(before.points, pointOf(now.time, interval))};
}

/** The history once there is another answer. */
export function historyAfter(before: History, {time, servers: answers}:
                                 MetricsAnswer): History {
  const servers = answers.map(answer => {
    const known = before.servers.find(({name}) => name === answer.name) ?? {
      name: answer.name, readings: [], interval: undefined, silence: undefined,
      points: [],
    };
    return serverAfter(known, time, answer);
  });
  const parts = servers.filter(({silence}) => !silence)
                    .map(({interval}) => interval)
                    .filter(interval => interval !== undefined);
  const total = parts.length > 0 ? new Total(parts) : undefined;
  return {
    servers, total,
    totalPoints: withPoint(before.totalPoints, pointOf(time, total)),
  };
}
