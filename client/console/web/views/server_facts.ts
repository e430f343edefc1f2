// Facts that follow from the metrics of one server, or of several together.
import {openOf} from '../data/server_history.js';
import type {Measures} from '../data/readings.js';
import type {Fact} from '../parts/facts.js';
import {age, bytes, count, fixed, rate} from '../parts/format.js';

/** The facts whose metric the server has. */
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

/** How many calls a second end with an error; undefined if nobody knows. */
export function errorRate(measures: Measures): number|undefined {
  const calls = measures.rate('revisit_calls_total');
  const ok = measures.rate('revisit_calls_total', {code: 'OK'}) ?? 0;
  return told(calls, all => Math.max(0, all - ok));
}

/** When the listener's certificate ends, in words; undefined without one. */
export function certificateEnd(measures: Measures): string|undefined {
  const now = measures.time / 1000;
  return told(
      measures.value('revisit_tls_certificate_expiry_timestamp_seconds'),
      end => end < now ? `${age(now - end)} ago` : `in ${age(end - now)}`);
}

/** All of them are right of several servers together too. */
export function loadFacts(measures: Measures): Fact[] {
  const open = openOf(measures);
  return known([
    ['Streams open', count(open.streams)],
    ['Unary calls open', count(open.calls)],
    ['Calls ended', told(measures.rate('revisit_calls_total'), rate)],
    ['Of them with an error', told(errorRate(measures), rate)],
    ['Poses accepted', told(measures.rate('revisit_poses_accepted_total'),
                            rate)],
    ['Poses refused', told(measures.rate('revisit_poses_refused_total'),
                           rate)],
    ['Searches', told(measures.rate('revisit_searches_total'), rate)],
    ['Batches that wait to be durable',
     told(measures.value('revisit_queued_bytes'), bytes)],
    ['New connections',
     told(measures.rate('revisit_connections_accepted_total'), rate)],
    ['Processors used', told(measures.rate('process_cpu_seconds_total'),
                             cores => fixed(cores, 2))],
    ['Resident memory',
     told(measures.value('process_resident_memory_bytes'), bytes)],
  ]);
}

/** All of them are right of several servers together too. */
export function residentFacts(measures: Measures): Fact[] {
  return known([
    ['Vehicles in memory',
     told(measures.value('revisit_resident_vehicles'), count)],
    ['Nodes in memory', told(measures.value('revisit_resident_nodes'), count)],
    ['Their memory', told(measures.value('revisit_resident_bytes'), bytes)],
  ]);
}

export function processFacts(measures: Measures): Fact[] {
  return known([
    ['Build', [...measures.by('revisit_build_info', 'build').keys()].join() ||
         undefined],
    ['Running for', told(measures.value('process_start_time_seconds'),
                         start => age(measures.time / 1000 - start))],
    ['Descriptors', told(measures.value('process_open_fds'), used => `${
         count(used)} of ${count(measures.value('process_max_fds') ?? NaN)}`)],
    ['Lines dropped from logs',
     told(measures.value('revisit_log_lines_dropped_total'), count)],
  ]);
}

export function storageFacts(measures: Measures): Fact[] {
  return known([
    ['Takes writes', told(measures.value('revisit_store_writable'), yesOrNo)],
    ['Size of the store', told(measures.value('revisit_store_bytes'), bytes)],
    ['Free beside it', told(measures.value('revisit_store_free_bytes'), bytes)],
    ['Refuses writes below',
     told(measures.value('revisit_store_min_free_bytes'), bytes)],
    ['Transactions', told(measures.rate('revisit_store_commits_total'), rate)],
    ['Writes in them', told(measures.rate('revisit_store_writes_total'),
                            rate)],
    ['Lease of the shared store held',
     told(measures.value('revisit_store_lease_held'), yesOrNo)],
    ['Vehicles owned',
     told(measures.value('revisit_store_owned_vehicles'), count)],
    ['Vehicles that others took',
     told(measures.value('revisit_store_lost_vehicles_total'), count)],
    ['Leases lost',
     told(measures.value('revisit_store_lost_leases_total'), count)],
  ]);
}

export function securityFacts(measures: Measures): Fact[] {
  const seconds = measures.time / 1000;
  const loaded = (files: string) =>
      told(measures.value('revisit_security_files_loaded_timestamp_seconds',
                          {files}), time => `${age(seconds - time)} ago`);
  return known([
    ['Certificate ends', certificateEnd(measures)],
    ['Certificate and key taken up', loaded('tls')],
    ['Policy and token keys taken up', loaded('access')],
    ['Newer ones are invalid',
     told(measures.value('revisit_security_files_refused'), yesOrNo)],
  ]);
}
