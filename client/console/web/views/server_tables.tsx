// Tables of latencies, limits, and how calls ended.
import {type Measures, quantile, type Quantile} from '../data/readings.js';
import {count, duration, percent, rate} from '../parts/format.js';
import {Table} from '../parts/table.js';

const LATENCIES: Array<[string, string]> = [
  ['Acknowledgement of a batch', 'revisit_ack_seconds'],
  ['Search', 'revisit_search_seconds'],
  ['Unary call', 'revisit_call_seconds'],
  ['Transaction of the store', 'revisit_store_commit_seconds'],
  ['Flush of the store', 'revisit_store_flush_seconds'],
];

export function quantileText(found: Quantile|undefined): string {
  if (!found) return '–';
  return (found.isBeyond ? '> ' : '') + duration(found.value);
}

export function rateText(value: number|undefined): string {
  return value === undefined ? '–' : rate(value);
}

interface Props {
  measures: Measures;
}

export function LatencyTable({measures}: Props) {
  const rows = LATENCIES.filter(
      ([, name]) => measures.value(`${name}_count`) !== undefined);
  return (
    <Table label="Latencies" rows={rows} keyOf={([, name]) => name} empty=""
           columns={[
             {title: 'Latency', cell: ([title]) => title},
             {title: 'p50', number: true, cell: ([, name]) =>
                quantileText(quantile(measures, name, 0.5))},
             {title: 'p99', number: true, cell: ([, name]) =>
                quantileText(quantile(measures, name, 0.99))},
             {title: 'A second', number: true, cell: ([, name]) =>
                rateText(measures.rate(`${name}_count`))},
             {title: 'Since the start', number: true, cell: ([, name]) =>
                count(measures.value(`${name}_count`) ?? 0)},
           ]} />
  );
}

/** Shares are of one server: those of several have no sum. */
export function LimitTable({measures}: Props) {
  const refusals = measures.by('revisit_limit_refusals_total', 'limit');
  const used = measures.by('revisit_limit_used_ratio', 'limit');
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

function EndTable({measures, metric, label, title}:
    Props&{metric: string, label: string, title: string}) {
  const rates = measures.ratesBy(metric, label);
  const rows = [...measures.by(metric, label)]
      .filter(([, number]) => number > 0).sort(([, a], [, b]) => b - a);
  return (
    <Table label={title} rows={rows} keyOf={([name]) => name} empty="None yet."
           columns={[
             {title, cell: ([name]) => name},
             {title: 'A second', number: true,
              cell: ([name]) => rateText(rates.get(name))},
             {title: 'Since the start', number: true,
              cell: ([, number]) => count(number)},
           ]} />
  );
}

/** How calls ended, and why those that failed did. */
export function EndTables({measures}: Props) {
  return (
    <>
      <EndTable measures={measures} metric="revisit_calls_total" label="code"
                title="Ended with" />
      <EndTable measures={measures} metric="revisit_call_errors_total"
                label="reason" title="Reason of an error" />
    </>
  );
}
