// A pair of poses by itself: when and where they are, and who else shows them.
import {useMemo} from 'preact/hooks';

import {linkFor, type LinkValues} from '../../shared/links.js';
import {consoleSettings} from '../data/console.js';
import type {Pair} from '../data/decisions.js';
import {type Graph, nodeAt} from '../data/graph.js';
import {type PlacedRecording, recordingOf} from '../data/recordings.js';
import type {VehicleStore} from '../data/vehicle.js';
import {MapView} from '../draw/map.js';
import {dots, type Scene, strokes} from '../draw/scene.js';
import {StretchesDrawer} from '../geometry/path.js';
import {boxAround} from '../geometry/view.js';
import {age, count, instant, length} from '../parts/format.js';
import {areInOneFrame, boxOfRecordings, isShownIn, recordingsOf} from
    './recordings.js';

/** Milliseconds since 1970 at a pose; NaN if it has no stamp. */
function timeAt(graph: Graph, sequence: number): number {
  const node = nodeAt(graph, sequence);
  return node < 0 ? NaN : graph.time[node];
}

function linkValues(store: VehicleStore, graph: Graph,
                           {query, matched}: Pair): LinkValues {
  const [a, b] = [timeAt(graph, query), timeAt(graph, matched)];
  const known = <T,>(time: number, text: T) =>
      Number.isNaN(time) ? undefined : text;
  return {
    vehicle: store.id,
    pose_a: String(query),
    pose_b: String(matched),
    time_a: known(a, Number.isNaN(a) ? '' : new Date(a).toISOString()),
    time_b: known(b, Number.isNaN(b) ? '' : new Date(b).toISOString()),
    unix_a: known(a, (a / 1000).toFixed(3)),
    unix_b: known(b, (b / 1000).toFixed(3)),
  };
}

function Links({store, graph, pair}:
    {store: VehicleStore, graph: Graph, pair: Pair}) {
  const templates = consoleSettings.value?.links ?? [];
  if (templates.length === 0) return null;
  const values = linkValues(store, graph, pair);
  return (
    <ul class="links" aria-label="This pair elsewhere">
      {templates.map(template => {
        const href = linkFor(template, values);
        return (
          <li key={template.name}>
            {href ?
              <a href={href} target="_blank" rel="noopener noreferrer">
                {template.name} ↗
              </a> :
              <span class="hint">{template.name}: these poses have no time
              </span>}
          </li>
        );
      })}
    </ul>
  );
}

/** Both poses with their times, and links that lead to them elsewhere. */
export function PairTable({store, graph, pair}:
    {store: VehicleStore, graph: Graph, pair: Pair}) {
  const recordings = store.recordings.value;
  const rows: Array<[string, number]> =
      [['A, query', pair.query], ['B, match', pair.matched]];
  const apart = (timeAt(graph, pair.query) - timeAt(graph, pair.matched)) /
      1000;
  return (
    <section class="pair" aria-label="Both poses">
      <table class="poses">
        <thead>
          <tr>
            <th scope="col">Pose</th>
            <th scope="col">Number</th>
            <th scope="col">Time</th>
            <th scope="col">Travelled</th>
          </tr>
        </thead>
        <tbody>
          {rows.map(([name, sequence]) => {
            const node = nodeAt(graph, sequence);
            const recording = recordingOf(recordings, node);
            return (
              <tr key={name}>
                <th scope="row">
                  {name}{recording && <>, in {recording.title}</>}
                </th>
                <td>{count(sequence)}</td>
                <td>{instant(timeAt(graph, sequence)) || 'no stamp'}</td>
                <td>{node < 0 ? '–' : length(graph.travelled[node])}</td>
              </tr>
            );
          })}
        </tbody>
      </table>
      {apart > 0 && <p class="hint">{age(apart)} lie between them.</p>}
      <Links store={store} graph={graph} pair={pair} />
    </section>
  );
}

type Recordings = readonly PlacedRecording[];

/** A map of the drive, or of some of its recordings, with those poses of a pair
 * that lie there. */
function SmallMap({graph, recordings, pair, label}: {
  graph: Graph, recordings: Recordings, pair: Pair, label: string,
}) {
  const path = useMemo(() => {
    const stretches: Array<[number, number]> = recordings.length === 0 ?
        [[0, graph.size - 1]] : recordings.map(({from, to}) => [from, to]);
    return {drawer: new StretchesDrawer(graph, stretches),
            box: recordings.length === 0 ? boxAround([...graph.pyramid.boxes]) :
                                           boxOfRecordings(graph, recordings)};
  }, [graph, recordings]);
  const scene: Scene = useMemo(() => {
    const at = (sequence: number) => {
      const i = Math.max(0, nodeAt(graph, sequence));
      return isShownIn(recordings, recordings, i) ? [graph.x[i], graph.y[i]] :
                                                    [];
    };
    const [query, matched] = [at(pair.query), at(pair.matched)];
    const isWhole = query.length > 0 && matched.length > 0;
    return {
      shapes: [
        {kind: 'strokes', id: 'whole path', label: 'Path', colour: 'path',
         widthPixels: 1.5, segmentsIn: view => path.drawer.segmentsIn(view)},
        strokes({id: 'pair', label: 'Pair', colour: 'selected',
                 widthPixels: 2}, isWhole ? [...query, ...matched] : []),
        dots({id: 'match', label: 'Match', colour: 'matched-path',
              radiusPixels: 7}, matched),
        dots({id: 'query', label: 'Query', colour: 'query-path',
              radiusPixels: 5}, query),
      ],
      box: path.box,
    };
  }, [graph, recordings, path, pair.query, pair.matched]);
  return <MapView small scene={scene} label={label} />;
}

/** Where in the whole drive both places lie; each in its own recording where the
 * frames of these are not tied. */
export function Locator({graph, recordings, pair}:
    {graph: Graph, recordings: Recordings, pair: Pair}) {
  const maps = useMemo(() => {
    const [query, matched] = recordingsOf(graph, recordings, pair);
    if (!query || !matched) return [];
    if (!areInOneFrame(graph, recordings, pair)) return [[query], [matched]];
    return [query.isPlaced ? recordings.filter(({isPlaced}) => isPlaced) :
                             [query]];
  }, [graph, recordings, pair.query, pair.matched]);
  if (maps.length === 2) {
    return (
      <>
        {maps.map((shown, i) => (
          <div key={shown[0].id}>
            <p class="hint">{i === 0 ? 'A' : 'B'}, in its own frame:{' '}
              {shown[0].title}</p>
            <SmallMap graph={graph} recordings={shown} pair={pair}
                      label={`Where pose ${
                          count(i === 0 ? pair.query : pair.matched)} lies in ${
                          shown[0].title}`} />
          </div>
        ))}
      </>
    );
  }
  return <SmallMap graph={graph} recordings={maps[0] ?? recordings} pair={pair}
                   label={`Where poses ${count(pair.query)} and ${
                       count(pair.matched)} lie in the whole drive`} />;
}
