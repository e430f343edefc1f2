// The part of the server's view that comes from metrics: of the one server, of
// the chosen one of several, or over all of them.
import {signal} from '@preact/signals';
import type {ComponentChildren} from 'preact';
import {useEffect, useMemo} from 'preact/hooks';

import {messageOf, repeat} from '../data/client.js';
import {consoleSettings} from '../data/console.js';
import {NoMetrics, readMetrics} from '../data/metrics.js';
import type {Measures} from '../data/readings.js';
import {type History, historyAfter, NO_HISTORY, type Point,
        type ServerHistory} from '../data/server_history.js';
import {type Curve, CurveView} from '../draw/curve.js';
import {type Fact, FactList} from '../parts/facts.js';
import {count} from '../parts/format.js';
import {metricsCurves} from './server_curves.js';
import {loadFacts, processFacts, residentFacts, securityFacts, storageFacts}
    from './server_facts.js';
import {listFacts, ServerList, Silences} from './server_list.js';
import {EndTables, LatencyTable, LimitTable} from './server_tables.js';

const POLL_MILLISECONDS = 1000;

/** The servers' metrics, or why there are none. */
export interface Metrics {
  history: History;
  /** The console tells this caller nothing. */
  refused: NoMetrics|undefined;
  /** Why the newest answer is missing: the history ends before it. */
  error: string|undefined;
}

/** Reads the metrics each second while the view is there. */
export function useMetrics(): Metrics {
  const metrics = useMemo(() => signal<Metrics>(
      {history: NO_HISTORY, refused: undefined, error: undefined}), []);
  const wanted = consoleSettings.value?.metrics;
  useEffect(() => {
    if (!wanted) return undefined;
    return repeat(POLL_MILLISECONDS, async () => {
      try {
        const answer = await readMetrics();
        metrics.value = {history: historyAfter(metrics.value.history, answer),
                         refused: undefined, error: undefined};
      } catch (error) {
        const refused = error instanceof NoMetrics ? error : undefined;
        metrics.value = refused?.status === 403 ?
            {history: NO_HISTORY, refused, error: undefined} :
            {...metrics.value, error: refused?.message ?? messageOf(error)};
      }
    });
  }, [wanted]);
  return metrics.value;
}

/** The server of this name; without a name the only one. */
function chosenOf({servers}: History, name: string|undefined):
    ServerHistory|undefined {
  if (name === undefined) return servers.length === 1 ? servers[0] : undefined;
  return servers.find(server => server.name === name);
}

/** The view has what is in the only server's memory from GetServerInfo. */
function factsOfOne(name: string|undefined): (measures: Measures) => Fact[] {
  return measures => [
    ...loadFacts(measures), ...processFacts(measures),
    ...(name === undefined ? [] : residentFacts(measures)),
  ];
}

function totalFacts(total: Measures): Fact[] {
  return [...loadFacts(total), ...residentFacts(total)];
}

/** The part of an exported view that is about metrics. */
export function metricsSheet({history}: Metrics, name: string|undefined):
    {facts: Fact[], curves: Curve[]} {
  const chosen = chosenOf(history, name);
  if (name !== undefined && !chosen) return {facts: [], curves: []};
  if (chosen) {
    const {interval, points} = chosen;
    return {
      facts: interval ? [
        ...factsOfOne(name)(interval), ...storageFacts(interval),
        ...securityFacts(interval),
      ] : [],
      curves: metricsCurves(points),
    };
  }
  const {total, totalPoints} = history;
  return {
    facts: [...(history.servers.length > 0 ? listFacts(history) : []),
            ...(total ? totalFacts(total) : [])],
    curves: metricsCurves(totalPoints),
  };
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

/** Numbers of one server, or of several together. `beside` stands beside the calls,
 * and `children` above the curves. */
function Details({measures, points, facts, beside, children}: {
  measures: Measures, points: Point[], facts: Fact[],
  beside?: ComponentChildren, children?: ComponentChildren,
}) {
  return (
    <>
      <FactSection title={measures.seconds > 0 ? `Load, over the last ${
          count(measures.seconds)} s` : 'Load'} facts={facts} />
      <h2>Latencies</h2>
      <LatencyTable measures={measures} />
      {beside ? (
        <div class="columns">
          {beside}
          <section>
            <h2>Calls</h2>
            <EndTables measures={measures} />
          </section>
        </div>
      ) : (
        <section>
          <h2>Calls</h2>
          <div class="columns"><EndTables measures={measures} /></div>
        </section>
      )}
      {children}
      <div class="curves">
        {metricsCurves(points).map(curve => (
          <CurveView key={curve.title} curve={curve} />
        ))}
      </div>
    </>
  );
}

function OneServer({server: {interval, silence, points}, facts}:
    {server: ServerHistory, facts: (measures: Measures) => Fact[]}) {
  if (!interval) return null;
  return (
    <>
      {silence && <p class="hint">What follows is from before.</p>}
      <Details measures={interval} points={points} facts={facts(interval)}
               beside={
                 <section>
                   <h2>Limits</h2>
                   <LimitTable measures={interval} />
                 </section>}>
        <FactSection title="Storage" facts={storageFacts(interval)} />
        <FactSection title="Certificates and keys"
                     facts={securityFacts(interval)} />
      </Details>
    </>
  );
}

/** `name` is that of the server to show, if the address has one. */
export function MetricsView({metrics, name}:
    {metrics: Metrics, name: string|undefined}) {
  const settings = consoleSettings.value;
  const {history, refused, error} = metrics;
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
  const {servers, total, totalPoints} = history;
  const chosen = chosenOf(history, name);
  return (
    <>
      {error && <p class="error" role="status">{error}</p>}
      {servers.length > 1 && <ServerList history={history} chosen={name} />}
      <Silences {...history} />
      {servers.length > 0 && name !== undefined && !chosen && (
        <p class="error" role="status">
          The console was given no metrics of a server that is called {name}.
        </p>
      )}
      {chosen && <OneServer server={chosen} facts={factsOfOne(name)} />}
      {!chosen && name === undefined && total && (
        <Details measures={total} points={totalPoints}
                 facts={totalFacts(total)} />
      )}
    </>
  );
}
