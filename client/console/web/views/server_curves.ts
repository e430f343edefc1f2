// The curves that are drawn of metrics.
import type {Point} from '../data/server_history.js';
import type {Curve} from '../draw/curve.js';

export function metricsCurves(points: Point[]): Curve[] {
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
  // Nothing is known of the time in which a server did not answer.
  const counted = {...shared, breaks: true};
  return [
    {title: 'Streams open', ...counted, series: [
      {label: 'streams', colour: 'path', as: 'line',
       values: points.map(({streams}) => streams)}]},
    {title: 'Calls and poses a second', ...counted, series: [
      {label: 'calls', colour: 'path', as: 'line',
       values: points.map(({calls}) => calls)},
      {label: 'poses', colour: 'closure', as: 'line',
       values: points.map(({poses}) => poses)}]},
    latency('Acknowledgement of a batch', 0),
    latency('Search', 1),
    latency('Unary call', 2),
    {title: 'Batches that wait to be durable, kB', ...counted, series: [
      {label: 'kB', colour: 'scale', as: 'line',
       values: points.map(({queuedBytes}) => queuedBytes === null ?
                                                 null : queuedBytes / 1000)}]},
  ];
}
