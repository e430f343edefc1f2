// The servers side by side, each in a row, and their totals.
import {type Measures, quantile} from '../data/readings.js';
import {type History, openOf, type ServerHistory} from
    '../data/server_history.js';
import type {Fact} from '../parts/facts.js';
import {bytes, count, moment} from '../parts/format.js';
import {type Column, Table} from '../parts/table.js';
import {certificateEnd, errorRate} from './server_facts.js';
import {quantileText, rateText} from './server_tables.js';

/** The key of the row of totals: no server is called so. */
const TOTAL = '';

interface Row {
  name: string;
  title: string;
  address: string;
  state: {name: string, text: string};
  /** Undefined for a server that does not answer. */
  measures: Measures|undefined;
}

/** The address of the view of one server. */
function addressOf(name: string): string {
  return `/server/${encodeURIComponent(name)}`;
}

function stateOf({interval, silence}: ServerHistory):
    {name: string, text: string} {
  if (silence) {
    return {name: 'silent', text: `no answer since ${moment(silence.since)}`};
  }
  if (!interval) return {name: 'asked', text: 'asked'};
  if (interval.value('revisit_draining') === 1) {
    return {name: 'limited', text: 'draining'};
  }
  if (interval.value('revisit_store_writable') === 0) {
    return {name: 'limited', text: 'refuses writes'};
  }
  return {name: 'up', text: 'up'};
}

function rowsOf({servers, total}: History): Row[] {
  const answering = servers.filter(
      ({interval, silence}) => interval && !silence).length;
  return [
    ...servers.map((server): Row => ({
      name: server.name, title: server.name, address: addressOf(server.name),
      state: stateOf(server),
      measures: server.silence ? undefined : server.interval,
    })),
    {name: TOTAL, title: 'All servers', address: '/server',
     state: {name: answering === servers.length ? 'up' :
                   answering > 0 ? 'limited' : 'silent',
             text: `${count(answering)} of ${count(servers.length)}`},
     measures: total},
  ];
}

/** A column of numbers; `–` stands where the server does not have one. */
function numbers(title: string, text: (measures: Measures, row: Row) =>
    string|undefined): Column<Row> {
  return {title, number: true,
          cell: row => row.measures && text(row.measures, row) || '–'};
}

function valueText(name: string, text: (value: number) => string):
    (measures: Measures) => string|undefined {
  return measures => {
    const value = measures.value(name);
    return value === undefined ? undefined : text(value);
  };
}

/** Nothing is said over all where it would not be a total. */
function ofEach(text: (measures: Measures) => string|undefined):
    (measures: Measures, row: Row) => string|undefined {
  return (measures, {name}) => name === TOTAL ? undefined : text(measures);
}

const COLUMNS: Array<Column<Row>> = [
  {title: 'Server',
   cell: ({title, address}) => <a href={address}>{title}</a>},
  {title: 'State', cell: ({state: {name, text}}) =>
     <span class={`state ${name}`}>{text}</span>},
  {title: 'Version', cell: ({measures}) => measures ?
     [...measures.by('revisit_build_info', 'version').keys()].join(', ') :
     '–'},
  numbers('Streams', measures => count(openOf(measures).streams)),
  numbers('Calls', measures => rateText(measures.rate('revisit_calls_total'))),
  numbers('Errors', measures => rateText(errorRate(measures))),
  numbers('Poses',
          measures => rateText(measures.rate('revisit_poses_accepted_total'))),
  numbers('Ack p99', measures => quantileText(
      quantile(measures, 'revisit_ack_seconds', 0.99))),
  numbers('Call p99', measures => quantileText(
      quantile(measures, 'revisit_call_seconds', 0.99))),
  numbers('Queue', valueText('revisit_queued_bytes', bytes)),
  numbers('Vehicles', valueText('revisit_resident_vehicles', count)),
  numbers('Their memory', valueText('revisit_resident_bytes', bytes)),
  // Servers may share a store, which each then tells the size of.
  numbers('Store', ofEach(valueText('revisit_store_bytes', bytes))),
  numbers('Certificate ends', ofEach(certificateEnd)),
];

/** `chosen` is the name of the server that is looked at, if one is. */
export function ServerList({history, chosen}:
    {history: History, chosen: string|undefined}) {
  return (
    <Table label="Servers" rows={rowsOf(history)} keyOf={({name}) => name}
           current={chosen ?? TOTAL} pinned empty="" columns={COLUMNS} />
  );
}

/** Tells of each server that does not answer, why not. */
export function Silences({servers}: History) {
  return (
    <>
      {servers.map(({name, silence}) => silence && (
        <p class="error" role="status" key={name}>
          {name} has not answered since {moment(silence.since)}.{' '}
          {silence.message}
        </p>
      ))}
    </>
  );
}

/** The same for a file: a line for each server. */
export function listFacts(history: History): Fact[] {
  return rowsOf(history).map(({title, state, measures}) => [
    title,
    [state.text, ...(measures ? [
      `${count(openOf(measures).streams)} streams`,
      `${rateText(measures.rate('revisit_calls_total'))} calls`,
      `${valueText('revisit_resident_vehicles', count)(measures) ?? '–'
      } vehicles in memory`,
    ] : [])].join(', '),
  ]);
}
