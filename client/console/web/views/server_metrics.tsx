// The part of the server's view that comes from its metrics.
import {signal} from '@preact/signals';
import {useEffect, useMemo} from 'preact/hooks';

import {messageOf, repeat} from '../data/client.js';
import {consoleSettings} from '../data/console.js';
import {NoMetrics, readMetrics} from '../data/metrics.js';
import {Interval, type Quantile, type Reading} from '../data/readings.js';
import {type Curve, CurveView} from '../draw/curve.js';
import {type Fact, FactList} from '../parts/facts.js';
import {age, bytes, count, duration, fixed, percent, rate} from
    '../parts/format.js';
import {Table} from '../parts/table.js';

const POLL_MILLISECONDS = 1000;
/** Rates and quantiles are of the last so many seconds. */
const WINDOW_MILLISECONDS = 10_000;
const MOST_POINTS = 600;
const STREAMS = ['StreamPoses', 'RevisePoses', 'ExportPoseGraph'];

const LATENCIES: Array<[string, string]> = [
  ['Acknowledgement of a batch', 'revisit_ack_seconds'],
  ['Search', 'revisit_search_seconds'],
  ['Unary call', 'revisit_call_seconds'],
  ['Transaction of the store', 'revisit_store_commit_seconds'],
  ['Flush of the store', 'revisit_store_flush_seconds'],
];

/** The numbers of one moment that are drawn as curves. */
interface Point {
  time: number;
  streams: number;
  calls: number|undefined;
  poses: number|undefined;
  queued: number|undefined;
  /** p50 and p99 of acknowledgements, searches and unary calls, in ms. */
  latencies: Array<[number|null, number|null]>;
}

/** All that is kept of the readings so far. */
export interface History {
  points: Point[];
  /** Since when rates are meant until now; undefined after one reading. */
  interval: Interval|undefined;
  refused: NoMetrics|undefined;
  error: string|undefined;
}

function milliseconds(quantile: Quantile|undefined): number|null {
  return quantile ? 1000 * quantile.value : null;
}

function pointOf(interval: Interval): Point {
  const {now} = interval;
  return {
    time: now.time,
    streams: openOf(now).streams,
    calls: interval.rate('revisit_calls_total'),
    poses: interval.rate('revisit_poses_accepted_total'),
    queued: now.value('revisit_queued_bytes'),
    latencies: LATENCIES.slice(0, 3).map(
        ([, name]) => [milliseconds(interval.quantile(name, 0.5)),
                       milliseconds(interval.quantile(name, 0.99))]),
  };
}

function openOf(now: Reading): {streams: number, calls: number} {
  const open = now.by('revisit_calls_open', 'method');
  const all = [...open.values()].reduce((sum, value) => sum + value, 0);
  const streams = STREAMS.reduce(
      (sum, method) => sum + (open.get(method) ?? 0), 0);
  return {streams, calls: all - streams};
}

/** Reads the metrics each second while the view is there. */
export function useMetrics(): History {
  const history = useMemo(() => signal<History>({
    points: [], interval: undefined, refused: undefined, error: undefined,
  }), []);
  const wanted = consoleSettings.value?.metrics;
  useEffect(() => {
    if (!wanted) return undefined;
    let readings: Reading[] = [];
    const isSameProcess = (a: Reading, b: Reading) =>
        a.value('process_start_time_seconds') ===
        b.value('process_start_time_seconds');
    return repeat(POLL_MILLISECONDS, async () => {
      try {
        const now = await readMetrics();
        readings = readings.filter(
            before => now.time - before.time <= WINDOW_MILLISECONDS &&
                before.time < now.time && isSameProcess(before, now));
        readings.push(now);
        const interval =
            readings.length > 1 ? new Interval(readings[0], now) : undefined;
        const {points} = history.value;
        history.value = {
          points: interval ?
              [...points, pointOf(interval)].slice(-MOST_POINTS) : points,
          interval: interval ?? history.value.interval,
          refused: undefined,
          error: undefined,
        };
      } catch (error) {
        const refused = error instanceof NoMetrics ? error : undefined;
        history.value = refused?.status === 403 ?
            {points: [], interval: undefined, refused, error: undefined} :
            {...history.value, error: refused?.message ?? messageOf(error)};
      }
    });
  }, [wanted]);
  return history.value;
}

/** Those facts whose metric the server has. */
function known(facts: Array<[string, string|undefined]>): Fact[] {
  return facts.filter((fact): fact is Fact =>
                          fact[1] !== undefined);
}

function told<T>(value: number|undefined, text: (value: number) => T):
    T|undefined {
  return value === undefined ? undefined : text(value);
}

function yesOrNo(value: number): string {
  return value > 0 ? 'yes' : 'no';
}

function loadFacts(interval: Interval): Fact[] {
  const {now} = interval;
  const open = openOf(now);
  const codes = interval.ratesBy('revisit_calls_total', 'code');
  const calls = interval.rate('revisit_calls_total');
  return known([
    ['Streams open', count(open.streams)],
    ['Unary calls open', count(open.calls)],
    ['Calls ended', told(calls, rate)],
    ['Of them with an error', told(calls, all => rate(
         Math.max(0, all - (codes.get('OK') ?? 0))))],
    ['Poses accepted', told(interval.rate('revisit_poses_accepted_total'),
                            rate)],
    ['Poses refused', told(interval.rate('revisit_poses_refused_total'),
                           rate)],
    ['Searches', told(interval.rate('revisit_searches_total'), rate)],
    ['Batches that wait to be durable',
     told(now.value('revisit_queued_bytes'), bytes)],
    ['New connections',
     told(interval.rate('revisit_connections_accepted_total'), rate)],
    ['Processors used', told(interval.rate('process_cpu_seconds_total'),
                             cores => fixed(cores, 2))],
    ['Memory of the process',
     told(now.value('process_resident_memory_bytes'), bytes)],
    ['Descriptors', told(now.value('process_open_fds'), used => `${
         count(used)} of ${count(now.value('process_max_fds') ?? NaN)}`)],
    ['Lines dropped from logs',
     told(now.value('revisit_log_lines_dropped_total'), count)],
    ['Running for', told(now.value('process_start_time_seconds'),
                         start => age(now.time / 1000 - start))],
  ]);
}

function storageFacts(interval: Interval): Fact[] {
  const {now} = interval;
  return known([
    ['Takes writes', told(now.value('revisit_store_writable'), yesOrNo)],
    ['Size of the store', told(now.value('revisit_store_bytes'), bytes)],
    ['Free beside it', told(now.value('revisit_store_free_bytes'), bytes)],
    ['Refuses writes below', told(now.value('revisit_store_min_free_bytes'),
                                  bytes)],
    ['Transactions', told(interval.rate('revisit_store_commits_total'), rate)],
    ['Writes in them', told(interval.rate('revisit_store_writes_total'),
                            rate)],
    ['Lease of the shared store held',
     told(now.value('revisit_store_lease_held'), yesOrNo)],
    ['Vehicles owned', told(now.value('revisit_store_owned_vehicles'), count)],
    ['Vehicles that others took',
     told(now.value('revisit_store_lost_vehicles_total'), count)],
    ['Leases lost', told(now.value('revisit_store_lost_leases_total'), count)],
  ]);
}

function securityFacts({now}: Interval): Fact[] {
  const seconds = now.time / 1000;
  const loaded = (files: string) =>
      told(now.value('revisit_security_files_loaded_timestamp_seconds',
                     {files}), time => `${age(seconds - time)} ago`);
  const end = now.value('revisit_tls_certificate_expiry_timestamp_seconds');
  return known([
    ['Certificate ends', told(end, time => time < seconds ?
         `${age(seconds - time)} ago` : `in ${age(time - seconds)}`)],
    ['Certificate and key taken up', loaded('tls')],
    ['Policy and token keys taken up', loaded('access')],
    ['Newer ones are invalid',
     told(now.value('revisit_security_files_refused'), yesOrNo)],
  ]);
}

function curvesOf(points: Point[]): Curve[] {
  if (points.length === 0) return [];
  const now = points[points.length - 1].time;
  const x = points.map(({time}) => (time - now) / 1000);
  const shared = {xLabel: 's from now', x,
                  xRange: [Math.min(-60, x[0]), 0] as [number, number]};
  const latency = (title: string, i: number): Curve => ({
    title: `${title}, ms`, ...shared, logarithmic: true, series: [
      {label: 'p50', colour: 'path', as: 'line',
       values: points.map(({latencies}) => latencies[i][0])},
      {label: 'p99', colour: 'query-path', as: 'line',
       values: points.map(({latencies}) => latencies[i][1])},
    ],
  });
  return [
    {title: 'Streams open', ...shared, series: [
      {label: 'streams', colour: 'path', as: 'line',
       values: points.map(({streams}) => streams)}]},
    {title: 'Calls and poses a second', ...shared, series: [
      {label: 'calls', colour: 'path', as: 'line',
       values: points.map(({calls}) => calls ?? null)},
      {label: 'poses', colour: 'closure', as: 'line',
       values: points.map(({poses}) => poses ?? null)}]},
    latency('Acknowledgement of a batch', 0),
    latency('Search', 1),
    latency('Unary call', 2),
    {title: 'Batches that wait to be durable, kB', ...shared, series: [
      {label: 'kB', colour: 'scale', as: 'line',
       values: points.map(({queued}) => queued === undefined ?
                                            null : queued / 1000)}]},
  ];
}

/** The part of an exported view that is about metrics. */
export function metricsSheet({interval, points}: History):
    {facts: Fact[], curves: Curve[]} {
  return {
    facts: interval ? [...loadFacts(interval), ...storageFacts(interval),
                       ...securityFacts(interval)] : [],
    curves: curvesOf(points),
  };
}

function quantileText(quantile: Quantile|undefined): string {
  if (!quantile) return '–';
  return (quantile.isBeyond ? '> ' : '') + duration(quantile.value);
}

function LatencyTable({interval}: {interval: Interval}) {
  const rows = LATENCIES.filter(
      ([, name]) => interval.now.value(`${name}_count`) !== undefined);
  return (
    <Table label="Latencies" rows={rows} keyOf={([, name]) => name} empty=""
           columns={[
             {title: 'Latency', cell: ([title]) => title},
             {title: 'p50', number: true, cell: ([, name]) =>
                quantileText(interval.quantile(name, 0.5))},
             {title: 'p99', number: true, cell: ([, name]) =>
                quantileText(interval.quantile(name, 0.99))},
             {title: 'A second', number: true, cell: ([, name]) =>
                rate(interval.rate(`${name}_count`) ?? 0)},
             {title: 'Since the start', number: true, cell: ([, name]) =>
                count(interval.now.value(`${name}_count`) ?? 0)},
           ]} />
  );
}

function LimitTable({now}: {now: Reading}) {
  const refusals = now.by('revisit_limit_refusals_total', 'limit');
  const used = now.by('revisit_limit_used_ratio', 'limit');
  const rows = [...used].sort(([a, x], [b, y]) => y - x || (a < b ? -1 : 1));
  const others = [...refusals].filter(
      ([limit, number]) => number > 0 && !used.has(limit));
  return (
    <Table label="Limits in use" empty=""
           rows={[...rows, ...others.map(([limit]):
                      [string, number|undefined] => [limit, undefined])]}
           keyOf={([limit]) => limit}
           columns={[
             {title: 'Limit', cell: ([limit]) => limit},
             {title: 'In use', cell: ([limit, share]) =>
                share === undefined ? '–' : (
                  <meter min={0} max={1} value={share}
                         aria-label={`Share of ${limit} in use`} />)},
             {title: 'Share', number: true, cell: ([, share]) =>
                share === undefined ? '–' : percent(share)},
             {title: 'Refusals', number: true, cell: ([limit]) =>
                count(refusals.get(limit) ?? 0)},
           ]} />
  );
}

function EndTable({interval, metric, label, title}:
    {interval: Interval, metric: string, label: string, title: string}) {
  const rates = interval.ratesBy(metric, label);
  const rows = [...interval.now.by(metric, label)]
      .filter(([, number]) => number > 0).sort(([, a], [, b]) => b - a);
  return (
    <Table label={title} rows={rows} keyOf={([name]) => name} empty="None yet."
           columns={[
             {title, cell: ([name]) => name},
             {title: 'A second', number: true,
              cell: ([name]) => rate(rates.get(name) ?? 0)},
             {title: 'Since the start', number: true,
              cell: ([, number]) => count(number)},
           ]} />
  );
}

function FactSection({title, facts}: {title: string, facts: Fact[]}) {
  if (facts.length === 0) return null;
  return (
    <section>
      <h2>{title}</h2>
      <FactList facts={facts} />
    </section>
  );
}

export function MetricsView({history}: {history: History}) {
  const settings = consoleSettings.value;
  const {interval, refused, error, points} = history;
  if (settings && !settings.metrics) {
    return (
      <p class="hint">
        Streams, latencies, limits in use and the store are shown if the
        console is started with <code>--metrics</code> and the address at which
        revisitd tells its metrics (<code>--admin-listen</code>), such as
        http://127.0.0.1:9464/metrics.
      </p>
    );
  }
  if (refused) {
    return (
      <p class="hint" role="status">
        Streams, latencies, limits in use and the store are not shown.{' '}
        {refused.message}
      </p>
    );
  }
  return (
    <>
      {error && <p class="error" role="status">{error}</p>}
      {interval && (
        <>
          <FactSection title={`Load, over the last ${
              count(interval.seconds)} s`} facts={loadFacts(interval)} />
          <h2>Latencies</h2>
          <LatencyTable interval={interval} />
          <div class="columns">
            <section>
              <h2>Limits</h2>
              <LimitTable now={interval.now} />
            </section>
            <section>
              <h2>Calls</h2>
              <EndTable interval={interval} metric="revisit_calls_total"
                        label="code" title="Ended with" />
              <EndTable interval={interval} metric="revisit_call_errors_total"
                        label="reason" title="Reason of an error" />
            </section>
          </div>
          <FactSection title="Storage" facts={storageFacts(interval)} />
          <FactSection title="Certificates and keys"
                    facts={securityFacts(interval)} />
          <div class="curves">
            {curvesOf(points).map(curve => (
              <CurveView key={curve.title} curve={curve} />
            ))}
          </div>
        </>
      )}
    </>
  );
}
