import {signal} from '@preact/signals';
import {useEffect, useMemo} from 'preact/hooks';

import {HealthCheckResponse_ServingStatus as Serving} from
    '../../gen/grpc/health/v1/health_pb.js';
import {Durability, type GetServerInfoResponse} from
    '../../gen/revisit/v1/pose_graph_service_pb.js';
import {health, messageOf, repeat, service} from '../data/client.js';
import {type Curve, CurveView} from '../draw/curve.js';
import {Export} from '../parts/export.js';
import {type Fact, FactList} from '../parts/facts.js';
import {bytes, count, fixed, words} from '../parts/format.js';
import {Table} from '../parts/table.js';
import {useTitle} from '../title.js';
import {metricsSheet, MetricsView, useMetrics} from './server_metrics.js';

const POLL_MILLISECONDS = 1000;
const MOST_SAMPLES = 600;

const HEALTH_NAMES: Array<[string, string]> = [
  ['', 'Server'],
  ['revisit.v1.PoseGraphService', 'Reads'],
  ['revisit.v1.PoseGraphService/write', 'Writes'],
];

const DURABILITY: Record<Durability, string> = {
  [Durability.UNSPECIFIED]: 'not said',
  [Durability.LOCAL]:
      'local: poses are flushed to one device, and outlive every process and ' +
      'a loss of power, not the device',
  [Durability.REPLICATED]:
      'replicated: a standby has flushed them too, and they outlive the loss ' +
      'of either device',
  [Durability.DEFERRED]:
      'deferred: acknowledged before they are flushed, so that a loss of ' +
      'power takes what was acknowledged last',
};

/** The answers to one round of questions. */
interface Sample {
  time: Date;
  info: GetServerInfoResponse;
  /** How long GetServerInfo took, from this page and back. */
  milliseconds: number;
  health: string[];
}

async function ask(): Promise<Sample> {
  const began = performance.now();
  const info = await service.getServerInfo({});
  const milliseconds = performance.now() - began;
  const statuses = await Promise.all(HEALTH_NAMES.map(
      ([name]) => health.check({service: name})
                      .then(({status}) => words(Serving[status]))
                      .catch(messageOf)));
  return {time: new Date(), info, milliseconds, health: statuses};
}

function factsOf({info, health: statuses, milliseconds, time}: Sample,
                 tellsResident: boolean): Fact[] {
  return [
    ['Version', info.version],
    ...HEALTH_NAMES.map(([, label], i): Fact => [label,
                                                            statuses[i]]),
    ['Durability', DURABILITY[info.durability]],
    ...(info.durabilitySettings ?
            [['Comes from', info.durabilitySettings] as Fact] :
            []),
    ['Format of the store', String(info.storeFormat)],
    ['Most poses in a batch', count(info.maxBatchPoses)],
    ['Largest message', bytes(info.maxMessageBytes)],
    ['Batches in flight of a stream', count(info.maxBatchesInFlight)],
    ...(tellsResident ? [
      ['Vehicles in memory', count(info.residentVehicleCount)],
      ['Nodes in memory', count(info.residentNodeCount)],
      ['Their memory', bytes(info.residentBytes)],
    ] as Fact[] : []),
    ['Round trip from this page', `${fixed(milliseconds, 1)} ms`],
    ['As of', time.toLocaleTimeString()],
  ];
}

function curvesOf(samples: Sample[], tellsResident: boolean): Curve[] {
  const now = samples[samples.length - 1].time.getTime();
  const x = samples.map(({time}) => (time.getTime() - now) / 1000);
  const shared = {xLabel: 's from now', x,
                  xRange: [Math.min(-60, x[0]), 0] as [number, number]};
  return [
    {title: 'Round trip of GetServerInfo from this page, ms', ...shared,
     series: [{label: 'ms', colour: 'path', as: 'line',
               values: samples.map(({milliseconds}) => milliseconds)}]},
    ...(tellsResident ? [{
      title: 'Nodes in memory', ...shared,
      series: [{label: 'nodes', colour: 'closure', as: 'line',
                values: samples.map(
                    ({info}) => Number(info.residentNodeCount))}],
    } as Curve] : []),
  ];
}

/** The server that answers the page's calls says these of itself. */
function AnsweringServer({last, facts, curves}:
    {last: Sample, facts: Fact[], curves: Curve[]}) {
  return (
    <>
      <FactList facts={facts} />
      {last.info.servers.length > 0 && (
        <Table label="Servers that share the store" rows={last.info.servers}
               keyOf={({address}) => address} empty="None"
               columns={[
                 {title: 'Server', cell: ({address}) => address},
                 {title: 'Vehicles it owns', number: true,
                  cell: ({ownedVehicleCount}) => count(ownedVehicleCount)},
               ]} />
      )}
      <div class="curves">
        {curves.map(curve => <CurveView key={curve.title} curve={curve} />)}
      </div>
    </>
  );
}

/** `name` is that of the one of several servers to show; undefined for the
 * view of all. */
export function ServerView({name}: {name: string|undefined}) {
  useTitle(name ?? 'Server');
  const {samples, error} = useMemo(() => ({
    samples: signal<Sample[]>([]),
    error: signal<string|undefined>(undefined),
  }), []);
  useEffect(() => repeat(POLL_MILLISECONDS, async () => {
    try {
      samples.value = [...samples.value, await ask()].slice(-MOST_SAMPLES);
      error.value = undefined;
    } catch (caught) {
      error.value = messageOf(caught);
      throw caught;
    }
  }), []);
  const metrics = useMetrics();
  const areSeveral = metrics.history.servers.length > 1;
  const last = name === undefined ?
      samples.value[samples.value.length - 1] : undefined;
  // Each of several may answer a call: how much is in the memory of which is
  // told by their metrics.
  const tellsResident = last !== undefined && last.info.overAllTenants &&
      !areSeveral;
  const facts = last && factsOf(last, tellsResident);
  const curves = last && curvesOf(samples.value, tellsResident);
  const title = name !== undefined ? `Server ${name}` :
      areSeveral ? 'Servers' : 'Server';
  const answering = last &&
      <AnsweringServer last={last} facts={facts!} curves={curves!} />;
  return (
    <>
      {name !== undefined && (
        <p class="crumbs"><a href="/server">All servers</a></p>
      )}
      <div class="title">
        <h1>{title}</h1>
        {(last || metrics.history.total) && (
          <Export name={title.toLowerCase().replace(/[^\w.]+/g, '-')}
                  sheet={() => {
            const more = metricsSheet(metrics, name);
            return {title, facts: [...facts ?? [], ...more.facts],
                    curves: [...curves ?? [], ...more.curves]};
          }} />
        )}
      </div>
      {error.value && <p class="error" role="status">{error.value}</p>}
      {!last && name === undefined && !error.value &&
        <p>Asking the server…</p>}
      {!areSeveral && answering}
      <MetricsView metrics={metrics} name={name} />
      {areSeveral && answering && (
        <section>
          <h2>The server that answers this page</h2>
          {answering}
        </section>
      )}
      {last && !last.info.overAllTenants && (
        <p class="hint">
          How much is in memory, and which servers share the store, is told to
          callers that belong to no tenant.
        </p>
      )}
    </>
  );
}
