import {useEffect, useLayoutEffect, useMemo, useRef, useState} from
    'preact/hooks';

import {Verdict} from '../../gen/revisit/v1/candidate_pb.js';
import {FindingCode, type Vehicle, VehicleState} from
    '../../gen/revisit/v1/vehicle_pb.js';
import {allFound, type Answer, type Found, keyOf, pairOf, verdictName} from
    '../data/candidates.js';
import {idle} from '../data/client.js';
import {type Decision, pairName, type Undone} from '../data/decisions.js';
import {type Graph, nodeAt} from '../data/graph.js';
import {SEARCHES_AT_ONCE, type VehicleStore, vehicleStore} from
    '../data/vehicle.js';
import {type Curve, CurveView} from '../draw/curve.js';
import {MapView} from '../draw/map.js';
import type {Scene} from '../draw/scene.js';
import type {MapSheet} from '../draw/svg.js';
import {tangentFrame} from '../geometry/frame.js';
import type {Box} from '../geometry/view.js';
import {Export} from '../parts/export.js';
import {type Fact, FactList} from '../parts/facts.js';
import {count, fixed, instant, length, words} from '../parts/format.js';
import {type Column, Table} from '../parts/table.js';
import {go, query, setQuery} from '../route.js';
import {useTitle} from '../title.js';
import {evidenceColumns} from './candidate_columns.js';
import {answersUpTo, candidateShapes, decisionShapes, ellipseShape, linkTo,
        openQueue, pathShapes, posesToAsk, stretchShapes, VERDICTS} from
    './drive.js';
import {boxOfRecordings, isShownIn, recordingNames, recordingShapes,
        RecordingTable, shownOf, ShownRecordings, tieText, titleOfMatch} from
    './recordings.js';
import {Settings} from './vehicle_settings.js';

const REPLAY_SECONDS = 60;
const FRAME_MILLISECONDS = 100;
const MOST_CURVE_POINTS = 2000;

function boxOfGraph({x, y, size}: Graph): Box|undefined {
  if (size === 0) return undefined;
  const box = {left: Infinity, right: -Infinity, bottom: Infinity,
               top: -Infinity};
  for (let i = 0; i < size; ++i) {
    box.left = Math.min(box.left, x[i]);
    box.right = Math.max(box.right, x[i]);
    box.bottom = Math.min(box.bottom, y[i]);
    box.top = Math.max(box.top, y[i]);
  }
  return box;
}

function columnsFor(store: VehicleStore, at: number): Array<Column<Found>> {
  const recordings = store.recordings.value;
  const decision = (found: Found) =>
      store.decisionAbout(pairOf(found), at)?.kind ?? '';
  return [
    {title: 'Pose', number: true, by: found => pairOf(found).query,
     cell: found => (
      <a href={linkTo(store, found)}
         aria-label={`${count(found.candidate.query!.sequence)} at pose ${
             count(found.candidate.matched!.sequence)}`}>
        {count(found.candidate.query!.sequence)}
      </a>)},
    {title: 'Match', number: true, by: found => pairOf(found).matched,
     cell: ({candidate}) => count(candidate.matched!.sequence)},
    ...evidenceColumns(),
    {title: 'Rank', number: true, by: ({candidate}) => candidate.rank,
     cell: ({candidate}) => candidate.rank},
    {title: 'Decision', by: decision, cell: decision},
    ...recordings.length > 0 ? [
      {title: 'Recording of the match',
       by: ({candidate}: Found) => titleOfMatch(recordings, candidate),
       cell: ({candidate}: Found) => titleOfMatch(recordings, candidate)},
      {title: 'Frames',
       by: ({candidate}: Found) => tieText(candidate),
       cell: ({candidate}: Found) => tieText(candidate)},
    ] : [],
  ];
}

/** The columns of decisions, which are named after `once` where they no longer
 * hold, with `more` before their notes. */
function decisionColumns<Shown extends Decision>(
    store: VehicleStore, once = '',
    more: Array<Column<Shown>> = []): Array<Column<Shown>> {
  return [
    {title: 'Pose', number: true, by: ({query}) => query, cell: decision => (
      <a href={store.addressOf(decision)}
         aria-label={`${once}${decision.kind} ${pairName(decision)}`}>
        {count(decision.query)}
      </a>)},
    {title: 'Match', number: true, by: ({matched}) => matched,
     cell: ({matched}) => count(matched)},
    {title: 'Decision', by: ({kind}) => kind, cell: ({kind}) => kind},
    {title: 'When', by: ({time}) => time, cell: ({time}) => instant(time)},
    {title: 'By', by: ({by}) => by, cell: ({by}) => by},
    ...more,
    {title: 'Note', by: ({note}) => note, cell: ({note}) => note},
  ];
}

function undoneColumns(store: VehicleStore): Array<Column<Undone>> {
  return decisionColumns<Undone>(store, 'once ', [
    {title: 'Undone', by: ({undoneTime}) => undoneTime,
     cell: ({undoneTime}) => instant(undoneTime)},
    {title: 'Undone by', by: ({undoneBy}) => undoneBy,
     cell: ({undoneBy}) => undoneBy},
  ]);
}

/** The decisions that were undone: they are read only where somebody opens
 * them. */
function UndoneDecisions({store, columns}:
    {store: VehicleStore, columns: Array<Column<Undone>>}) {
  const [open, setOpen] = useState(false);
  const {decisions} = store;
  useEffect(() => {
    if (!open) return undefined;
    decisions.showUndone(true);
    return () => decisions.showUndone(false);
  }, [decisions, open]);
  const undone = decisions.undone.value;
  const error = decisions.undoneError.value;
  return (
    <details class="undone"
             onToggle={event => setOpen(event.currentTarget.open)}>
      <summary>Undone decisions</summary>
      {open && error && <p class="error" role="status">{error}</p>}
      {open && !undone && !error && <p role="status">Asking the server…</p>}
      {open && undone && (
        <Table label="Undone decisions" columns={columns} rows={undone}
               keyOf={({deletion}) => deletion}
               empty="Nobody has undone any." />
      )}
    </details>
  );
}

/** Curves up to node `cut`. */
function curvesOf(graph: Graph, vehicle: Vehicle, answers: Map<number, Answer>,
                  cut: number): Curve[] {
  const newest = Number(vehicle.durableSequence);
  const sets = [...answers.values()].filter(({set}) => set);
  const x = sets.map(({asked}) => asked);
  const best = sets.map(({set}) => set!.candidates[0]);
  const shared = {xLabel: 'pose',
                  xRange: [1, newest] as [number, number]};
  const step = Math.ceil((cut + 1) / MOST_CURVE_POINTS);
  const nodes = Array.from({length: Math.ceil((cut + 1) / step)},
                           (_, i) => i * step);
  return [
    {title: 'd² of the first candidate', ...shared, x, logarithmic: true,
     series: [
       {label: 'd²', colour: 'path', as: 'points', values: best.map(
          first => first?.gate?.squaredMahalanobisDistance || null)},
       {label: 'gate', colour: 'threshold', as: 'dashes',
        values: best.map(first => first?.gate?.threshold ?? null)},
     ]},
    {title: 'Probability', ...shared, x, series: [
       {label: 'first candidate', colour: 'path', as: 'points',
        values: best.map(first => first?.probability ?? null)},
       {label: 'a place not seen before', colour: 'uninformative',
        as: 'line', values: sets.map(
            ({set}) => set!.newPlaceProbability ?? null)},
       {label: 'needed', colour: 'threshold', as: 'dashes', values: x.map(
          () => vehicle.settings?.acceptanceProbability ?? null)},
     ]},
    {title: 'Learned scale of the claimed deviations', ...shared, x,
     logarithmic: true, series: [
       {label: 'scale', colour: 'scale', as: 'line',
        values: sets.map(({set}) => set!.scaleEstimate?.scale ?? null)},
       {label: 'at least', colour: 'threshold', as: 'dashes',
        values: sets.map(({set}) => set!.scaleEstimate?.low ?? null)},
       {label: 'at most', colour: 'threshold', as: 'dashes',
        values: sets.map(({set}) => set!.scaleEstimate?.high ?? null)},
     ]},
    {title: 'Travelled, km', ...shared, x: nodes.map(i => graph.sequence[i]),
     series: [{label: 'km', colour: 'closure', as: 'line',
               values: nodes.map(i => graph.travelled[i] / 1000)}]},
  ];
}

function factsNow(vehicle: Vehicle, store: VehicleStore): Fact[] {
  const {consistency} = vehicle;
  return [
    ['State', words(VehicleState[vehicle.state])],
    ['Poses', count(vehicle.durableSequence)],
    ['Nodes', count(vehicle.nodeCount)],
    ['Travelled', length(vehicle.travelledMeters)],
    ['Loop closures', count(store.decisions.closures.value.length)],
    ['Rejected', count(store.decisions.rejections.value.length)],
    ['Inflation', consistency ? fixed(consistency.inflation, 2) : '–'],
    ['Revision', count(vehicle.revision)],
    ...store.recordings.value.length > 0 ? [
      ['Recordings', count(store.recordings.value.length)] as Fact] : [],
  ];
}

/** The numbers that were so at pose `at`, whose node is `cut`. State, inflation
 * and findings are known of the newest pose only. */
function factsThen(store: VehicleStore, graph: Graph, at: number,
                   cut: number): Fact[] {
  const made = (decisions: readonly Decision[]) => count(
      decisions.filter(({query: pose}) => pose <= at).length);
  return [
    ['Poses', count(at)],
    ['Nodes', count(cut + 1)],
    ['Travelled', length(graph.travelled[cut])],
    ['Loop closures', made(store.decisions.closures.value)],
    ['Rejected', made(store.decisions.rejections.value)],
  ];
}

interface SliderProps {
  newest: number;
  at: number;
  live: boolean;
}

/** Where in the drive the view stands; at its end it follows the vehicle. */
function Slider({newest, at, live}: SliderProps) {
  const [playing, setPlaying] = useState(false);
  useEffect(() => {
    if (!playing) return undefined;
    const step = newest * FRAME_MILLISECONDS / (1000 * REPLAY_SECONDS);
    let position = live ? 1 : at;
    const timer = setInterval(() => {
      position += step;
      if (position < newest) {
        setQuery('at', String(Math.round(position)));
      } else {
        setQuery('at', undefined);
        setPlaying(false);
      }
    }, FRAME_MILLISECONDS);
    return () => clearInterval(timer);
  }, [playing]);
  const move = (event: Event) => {
    setPlaying(false);
    const value = Number((event.target as HTMLInputElement).value);
    setQuery('at', value >= newest ? undefined : String(value));
  };
  return (
    <div class="slider">
      <button type="button" onClick={() => setPlaying(!playing)}>
        {playing ? 'Stop' : 'Replay'}
      </button>
      <label>
        <span>Up to pose</span>
        <input type="range" min={1} max={Math.max(newest, 1)} value={at}
               onInput={move} />
      </label>
      <output>{count(at)}{live ? ' (newest)' : ''}</output>
      {!live && (
        <button type="button" onClick={() => setQuery('at', undefined)}>
          Newest
        </button>
      )}
    </div>
  );
}

/** These are drawn unless the address says otherwise. */
const SHOWN_AT_FIRST = ['ellipse', 'accepted'];

function shownIn(filters: URLSearchParams): Set<string> {
  const named = filters.get('show');
  return new Set(named === null ? SHOWN_AT_FIRST :
                                  named.split(',').filter(Boolean));
}

function Shown({shown, found}: {shown: Set<string>, found: Found[]}) {
  const show = (names: Iterable<string>) => {
    const text = [...names].join();
    setQuery('show', text === SHOWN_AT_FIRST.join() ? undefined : text);
  };
  const all = ['ellipse', ...VERDICTS.map(({colour}) => colour)];
  const toggle = (name: string) => show(all.filter(
      other => shown.has(other) !== (other === name)));
  return (
    <fieldset class="verdicts">
      <legend>Shown</legend>
      <label class="check">
        <input type="checkbox" checked={shown.has('ellipse')}
               onChange={() => toggle('ellipse')} />
        95 % ellipses
      </label>
      {VERDICTS.map(({verdict, colour}) => {
        const number = found.filter(
            ({candidate}) => candidate.verdict === verdict).length;
        return (
          <label key={colour} class="check">
            <input type="checkbox" checked={shown.has(colour)}
                   onChange={() => toggle(colour)} />
            <span class={`verdict ${colour}`}>{verdictName(verdict)}</span>
            <span class="count">{number}</span>
          </label>
        );
      })}
      <button type="button" onClick={() => show(all)}>All</button>
    </fieldset>
  );
}

/** Which checks were searched, and how to search more of them, or anew. */
function Searches({store, at}: {store: VehicleStore, at: number}) {
  const checks = store.checks.value;
  const answers = store.candidates.answers.value;
  const askable = posesToAsk(checks, at, store.searches.value);
  const due = checks.filter(({pose}) => pose <= at).length;
  const known = askable.filter(pose => answers.get(pose)?.set).length;
  const old = askable.filter(pose => answers.get(pose)?.outdated).length;
  const failed = askable.map(pose => answers.get(pose)?.error)
                     .find(error => error);
  const more = Math.min(SEARCHES_AT_ONCE, due - askable.length);
  return (
    <>
      <p class="hint" role="status">
        {checks.length === 0 ?
          'No check has fallen due yet.' :
          `${count(known)} of ${count(askable.length)} checks answered`}
        {idle.value && known < askable.length &&
          ', the rest once somebody is back'}
        {failed && `. ${failed}`}
      </p>
      {old > 0 && (
        <p class="hint">
          {count(old)} of the answers are from before something changed.{' '}
          <button type="button" onClick={() => store.candidates.askAnew()}>
            Search {count(old)} anew
          </button>
        </p>
      )}
      {more > 0 && (
        <p class="hint">
          {count(due)} checks fell due up to this pose: candidates are those of
          the last {count(askable.length)}.{' '}
          <button type="button"
                  onClick={() => store.searches.value += SEARCHES_AT_ONCE}>
            Search {count(more)} earlier ones
          </button>
        </p>
      )}
    </>
  );
}

/** The way to what is to be decided: by a key from anywhere in the view. */
function Review({store, queue}: {store: VehicleStore, queue: Found[]}) {
  const first = queue.length > 0 ? linkTo(store, queue[0]) : undefined;
  const latest = useRef(first);
  latest.current = first;
  useLayoutEffect(() => {
    const onKey = (event: KeyboardEvent) => {
      const isTyping = (event.target as HTMLElement).closest(
          'input, textarea, select, [role=region]');
      if (event.key !== 'j' || event.ctrlKey || event.metaKey ||
          event.altKey || isTyping || !latest.current) {
        return;
      }
      event.preventDefault();
      go(latest.current);
    };
    addEventListener('keydown', onKey);
    return () => removeEventListener('keydown', onKey);
  }, []);
  return first ?
    <a class="button" href={first}>
      Review {count(queue.length)} open <kbd>j</kbd>
    </a> :
    <span class="hint">Nothing to review among the checks searched.</span>;
}

export function VehicleView({id}: {id: string}) {
  const store = vehicleStore(id);
  const vehicle = store.vehicle.value;
  const graph = store.graph.value;
  const checks = store.checks.value;
  const most = store.searches.value;
  const {closures, rejections, all: everyDecision} = store.decisions;
  const sheet = useRef<MapSheet>();
  const [pointed, setPointed] = useState<string>();
  const newest = Number(vehicle?.durableSequence ?? 0);
  const asked = Number(query.value.get('at') ?? NaN);
  const live = !(asked >= 1 && asked < newest);
  const at = live ? newest : asked;
  const shown = useMemo(() => shownIn(query.value), [query.value]);

  useEffect(() => store.candidates.want(posesToAsk(checks, at, most)),
            [store, checks, at, most]);
  const allAnswers = store.candidates.answers.value;
  const answers = useMemo(() => answersUpTo(allAnswers, at), [allAnswers, at]);
  const found = useMemo(() => allFound(answers), [answers]);
  const queue = openQueue(store);
  const colours = new Map(VERDICTS.map(({verdict, colour}) =>
                                           [verdict, colour]));
  const listed = useMemo(
      () => found.filter(({candidate: {verdict}}) =>
                             shown.has(colours.get(verdict)!)),
      [found, shown]);

  const recordings = store.recordings.value;
  const chosen = query.value.get('recording');
  const onMap = useMemo(() => shownOf(recordings, chosen),
                        [recordings, chosen]);
  const isOnMap = (pose: number) =>
      isShownIn(recordings, onMap, nodeAt(graph!, pose));
  const arePairsOnMap = ({query: a, matched: b}:
      Pick<Decision, 'query'|'matched'>) => isOnMap(a) && isOnMap(b);
  const drawn = useMemo(
      () => graph ? listed.filter(one => arePairsOnMap(pairOf(one))) : [],
      [graph, listed, onMap]);

  const cut = graph ? Math.max(0, nodeAt(graph, at)) : 0;
  const paths = useMemo(
      () => !graph || graph.size === 0 ? [] : recordings.length === 0 ?
          pathShapes(graph, cut) :
          recordingShapes(graph, recordings, onMap, cut),
      [graph, recordings, onMap, cut]);
  const names = useMemo(
      () => graph && recordingNames(
          graph, recordings, onMap.filter(({from}) => from <= cut)),
      [graph, recordings, onMap, cut]);
  const ellipses = useMemo(
      () => graph && shown.has('ellipse') ? [ellipseShape(graph,
                                  checks.filter(
                                      ({pose}) => pose <= at && isOnMap(pose))
                                      .map(({node}) => node))] : [],
      [graph, checks, at, shown, onMap]);
  const stretches = useMemo(
      () => graph ? stretchShapes(
                        graph, recordings, drawn.filter(({candidate}) =>
                                   candidate.verdict === Verdict.ACCEPTED),
                        cut) :
                    [],
      [graph, drawn, cut]);
  const links = useMemo(
      () => graph ? candidateShapes(store, graph, drawn) : [],
      [graph, drawn]);
  const decided = useMemo(() => graph ? [
    ...decisionShapes(store, graph, {id: 'closures', label: 'Loop closure',
                                     colour: 'closure'},
                     closures.value.filter(arePairsOnMap), at),
    ...decisionShapes(store, graph, {
      id: 'rejections', label: 'Rejected by a verifier', colour: 'rejection',
      dash: [4, 4]}, rejections.value.filter(arePairsOnMap), at),
  ] : [], [graph, closures.value, rejections.value, at, onMap]);
  const decisions = useMemo(
      () => everyDecision.value.filter(({query: pose}) => pose <= at)
                .sort((a, b) => b.query - a.query),
      [everyDecision.value, at]);
  const box = useMemo(
      () => graph && (recordings.length === 0 ?
          boxOfGraph(graph) : boxOfRecordings(graph, onMap)),
      [graph, recordings, onMap]);
  const scene: Scene = useMemo(() => ({
    shapes: [...ellipses, ...stretches, ...paths.slice(0, -1), ...links,
             ...decided, ...paths.slice(-1)],
    box,
    names,
  }), [ellipses, stretches, links, paths, decided, box, names]);
  const origin = vehicle?.settings?.geodeticOrigin;
  const frame = useMemo(() => origin && tangentFrame({
    latitude: origin.latitudeDegrees, longitude: origin.longitudeDegrees,
  }, origin.heightMeters), [origin?.latitudeDegrees, origin?.longitudeDegrees,
                            origin?.heightMeters]);
  const curves = useMemo(
      () => graph && vehicle ? curvesOf(graph, vehicle, answers, cut) : [],
      [graph, vehicle, answers, cut]);
  const columns = useMemo(() => columnsFor(store, at),
                          [store, at, everyDecision.value, graph, recordings]);
  const forDecisions = useMemo(() => decisionColumns(store),
                               [store, checks]);
  const forUndone = useMemo(() => undoneColumns(store), [store, checks]);
  const name = vehicle?.displayName || id;
  useTitle(name);
  return (
    <>
      <div class="title">
        <h1>{name}</h1>
        {name !== id && <code>{id}</code>}
        {graph && <Review store={store} queue={queue} />}
        <p role="status">
          {graph ? `Map of revision ${count(graph.revision)}, ${
                       count(graph.size)} nodes` :
                   'Asking the server…'}
          {store.loading.value !== undefined && (!graph ||
              store.loading.value > 100_000) &&
            `, loading ${count(store.loading.value)} nodes`}
        </p>
        <Export name={id} sheet={() => ({
          title: `${name}, up to pose ${count(at)}`,
          map: sheet.current,
          curves,
        })} />
      </div>
      {store.error.value &&
        <p class="error" role="status">{store.error.value}</p>}
      {vehicle && (live || !graph || graph.size === 0 ?
        <FactList short facts={factsNow(vehicle, store)} /> :
        <FactList short facts={factsThen(store, graph, at, cut)} />)}
      {vehicle?.settings && <Settings settings={vehicle.settings} />}
      {live && vehicle?.findings.map(({code, message}) => (
        <p class="error" key={code}>
          <strong>{words(FindingCode[code])}</strong>: {message}
        </p>
      ))}
      {graph && graph.size > 0 && (
        <>
          <Slider newest={newest} at={at} live={live} />
          <div class="map-and-table">
            <MapView key={chosen} scene={scene} frame={frame} shownRef={sheet}
                     pointed={pointed} onPoint={setPointed}
                     label={`Map of the path of ${name}; the table has its ` +
                            'candidates'} />
            <div class="side">
              {recordings.length > 0 && (
                <>
                  <ShownRecordings recordings={recordings} chosen={chosen} />
                  <RecordingTable recordings={recordings} chosen={chosen} />
                </>
              )}
              <Shown shown={shown} found={found} />
              <Searches store={store} at={at} />
              <Table label="Candidates" columns={columns} rows={listed}
                     keyOf={keyOf} pointed={pointed} onPoint={setPointed}
                     empty={found.length > 0 ? 'None of those shown.' :
                                               'No candidates.'} />
              <Table label="Decisions" columns={forDecisions}
                     rows={decisions} keyOf={({name: key}) => key}
                     pointed={pointed} onPoint={setPointed}
                     empty="Nobody has confirmed or rejected any." />
              <UndoneDecisions store={store} columns={forUndone} />
            </div>
          </div>
          <div class="curves">
            {curves.map(curve => (
              <CurveView key={curve.title} curve={curve} at={at}
                         onPick={x => setQuery('at', String(Math.round(
                             Math.min(Math.max(1, x), newest))))} />
            ))}
          </div>
        </>
      )}
      {graph?.size === 0 && <p>The vehicle has no poses yet.</p>}
    </>
  );
}
