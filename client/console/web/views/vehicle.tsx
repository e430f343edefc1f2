import {useEffect, useMemo, useRef, useState} from 'preact/hooks';

import {Verdict} from '../../gen/revisit/v1/candidate_pb.js';
import {FindingCode, type Vehicle, VehicleState} from
    '../../gen/revisit/v1/vehicle_pb.js';
import {allFound, type Answer, type Found, keyOf, verdictName} from
    '../data/candidates.js';
import {type Graph, nodeAt} from '../data/graph.js';
import {type Decision, type VehicleStore, vehicleStore} from
    '../data/vehicle.js';
import {type Curve, CurveView} from '../draw/curve.js';
import {MapView} from '../draw/map.js';
import type {Scene} from '../draw/scene.js';
import type {MapSheet} from '../draw/svg.js';
import {tangentFrame} from '../geometry/frame.js';
import type {Box} from '../geometry/view.js';
import {Export} from '../parts/export.js';
import {type Fact, FactList} from '../parts/facts.js';
import {count, fixed, length, probability, words} from '../parts/format.js';
import {type Column, Table} from '../parts/table.js';
import {query, setQuery} from '../route.js';
import {answersUpTo, candidateShapes, decisionAbout, ellipseShape, linkTo,
        MOST_CHECKS, pairShapes, pathShapes, posesToAsk, stretchShapes,
        VERDICTS} from './drive.js';

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
  return [
    {title: 'Pose', number: true, cell: found => (
      <a href={linkTo(store, found)}
         aria-label={`${count(found.candidate.query!.sequence)} at pose ${
             count(found.candidate.matched!.sequence)}`}>
        {count(found.candidate.query!.sequence)}
      </a>)},
    {title: 'Match', number: true,
     cell: ({candidate}) => count(candidate.matched!.sequence)},
    {title: 'Verdict', cell: ({candidate: {verdict}}) => (
      <span class={`verdict ${words(Verdict[verdict]).replaceAll(' ', '-')}`}>
        {verdictName(verdict)}
      </span>)},
    {title: 'Probability', number: true, cell: ({candidate}) =>
       candidate.probability === undefined ?
           '–' : probability(candidate.probability)},
    {title: 'd² / gate', number: true, cell: ({candidate: {gate}}) =>
       `${fixed(gate!.squaredMahalanobisDistance, 2)} / ${
           fixed(gate!.threshold, 2)}`},
    {title: 'Rank', number: true, cell: ({candidate}) => candidate.rank},
    {title: 'Decision', cell: ({candidate}) =>
       decisionAbout(store, candidate, at)?.kind ?? ''},
  ];
}

const DECISION_COLUMNS: Array<Column<Decision>> = [
  {title: 'Pose', number: true,
   cell: ({querySequence}) => count(querySequence)},
  {title: 'Match', number: true,
   cell: ({matchedSequence}) => count(matchedSequence)},
  {title: 'Decision', cell: ({kind}) => kind},
  {title: 'Note', cell: ({note}) => note},
];

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
    ['Loop closures', count(store.closures.value.length)],
    ['Rejected', count(store.rejections.value.length)],
    ['Inflation', consistency ? fixed(consistency.inflation, 2) : '–'],
    ['Revision', count(vehicle.revision)],
  ];
}

/** The numbers that were so at pose `at`, whose node is `cut`. State, inflation
 * and findings are known of the newest pose only. */
function factsThen(store: VehicleStore, graph: Graph, at: number,
                   cut: number): Fact[] {
  const made = (decisions: ReadonlyArray<{querySequence: bigint}>) => count(
      decisions.filter(
          ({querySequence}) => Number(querySequence) <= at).length);
  return [
    ['Poses', count(at)],
    ['Nodes', count(cut + 1)],
    ['Travelled', length(graph.travelled[cut])],
    ['Loop closures', made(store.closures.value)],
    ['Rejected', made(store.rejections.value)],
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

function Shown({hidden, found}: {hidden: Set<string>,
                                         found: Found[]}) {
  const toggle = (name: string) => {
    const changed = new Set(hidden);
    if (!changed.delete(name)) changed.add(name);
    setQuery('hide', [...changed].join(',') || undefined);
  };
  return (
    <fieldset class="verdicts">
      <legend>Shown</legend>
      <label class="check">
        <input type="checkbox" checked={!hidden.has('ellipse')}
               onChange={() => toggle('ellipse')} />
        95 % ellipses
      </label>
      {VERDICTS.map(({verdict, colour}) => {
        const number = found.filter(
            ({candidate}) => candidate.verdict === verdict).length;
        return (
          <label key={colour} class="check">
            <input type="checkbox" checked={!hidden.has(colour)}
                   onChange={() => toggle(colour)} />
            <span class={`verdict ${colour}`}>{verdictName(verdict)}</span>
            <span class="count">{number}</span>
          </label>
        );
      })}
    </fieldset>
  );
}

export function VehicleView({id}: {id: string}) {
  const store = vehicleStore(id);
  const vehicle = store.vehicle.value;
  const graph = store.graph.value;
  const checks = store.checks.value;
  const sheet = useRef<MapSheet>();
  const newest = Number(vehicle?.durableSequence ?? 0);
  const asked = Number(query.value.get('at') ?? NaN);
  const live = !(asked >= 1 && asked < newest);
  const at = live ? newest : asked;
  const hidden = useMemo(
      () => new Set((query.value.get('hide') ?? '').split(',').filter(Boolean)),
      [query.value]);

  useEffect(() => store.candidates.want(posesToAsk(checks, at)),
            [store, checks, at]);
  const allAnswers = store.candidates.answers.value;
  const answers = useMemo(() => answersUpTo(allAnswers, at), [allAnswers, at]);
  const found = useMemo(() => allFound(answers), [answers]);
  const colours = new Map(VERDICTS.map(({verdict, colour}) =>
                                           [verdict, colour]));
  const shown = useMemo(
      () => found.filter(({candidate: {verdict}}) =>
                             !hidden.has(colours.get(verdict)!)),
      [found, hidden]);

  const cut = graph ? Math.max(0, nodeAt(graph, at)) : 0;
  const paths = useMemo(() => graph && graph.size > 0 ?
                            pathShapes(graph, cut) : [], [graph, cut]);
  const ellipses = useMemo(
      () => graph && !hidden.has('ellipse') ? [ellipseShape(graph,
                                  checks.filter(({pose}) => pose <= at)
                                      .map(({node}) => node))] : [],
      [graph, checks, at, hidden]);
  const stretches = useMemo(
      () => graph ? stretchShapes(
                        graph, shown.filter(({candidate}) =>
                                   candidate.verdict === Verdict.ACCEPTED),
                        cut) :
                    [],
      [graph, shown, cut]);
  const links = useMemo(() => candidateShapes(store, shown), [shown]);
  const decided = useMemo(() => graph ? [
    ...pairShapes(graph, {id: 'closures', label: 'Loop closure',
                      colour: 'closure'}, store.closures.value, at),
    ...pairShapes(graph, {id: 'rejections', label: 'Rejected by a verifier',
                      colour: 'rejection'}, store.rejections.value, at),
  ] : [], [graph, store.closures.value, store.rejections.value, at]);
  const decisions = useMemo(
      () => store.allDecisions.value
                .filter(({querySequence}) => querySequence <= at)
                .sort((a, b) => b.querySequence - a.querySequence),
      [store.allDecisions.value, at]);
  const box = useMemo(() => graph && boxOfGraph(graph), [graph]);
  const scene: Scene = useMemo(() => ({
    shapes: [...ellipses, ...stretches, ...paths.slice(0, -1), ...links,
             ...decided, ...paths.slice(-1)],
    box,
  }), [ellipses, stretches, links, paths, decided, box]);
  const origin = vehicle?.settings?.geodeticOrigin;
  const frame = useMemo(() => origin && tangentFrame({
    latitude: origin.latitudeDegrees, longitude: origin.longitudeDegrees,
  }, origin.heightMeters), [origin?.latitudeDegrees, origin?.longitudeDegrees,
                            origin?.heightMeters]);
  const curves = useMemo(
      () => graph && vehicle ? curvesOf(graph, vehicle, answers, cut) : [],
      [graph, vehicle, answers, cut]);
  const columns = useMemo(() => columnsFor(store, at), [store, at]);

  const waiting = [...answers.values()].filter(({outdated}) => outdated).length;
  const askable = posesToAsk(checks, at);
  const due = checks.filter(({pose}) => pose <= at).length;
  const known = askable.filter(pose => answers.get(pose)?.set).length;
  const failed = [...answers.values()].find(({error}) => error)?.error;
  const name = vehicle?.displayName || id;
  return (
    <>
      <div class="title">
        <h1>{name}</h1>
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
      {live && vehicle?.findings.map(({code, message}) => (
        <p class="error" key={code}>
          <strong>{words(FindingCode[code])}</strong>: {message}
        </p>
      ))}
      {graph && graph.size > 0 && (
        <>
          <Slider newest={newest} at={at} live={live} />
          <div class="map-and-table">
            <MapView scene={scene} frame={frame} shownRef={sheet}
                     label={`Map of the path of ${name}; the table has its ` +
                            'candidates'} />
            <div class="side">
              <Shown hidden={hidden} found={found} />
              <p class="hint" role="status">
                {checks.length === 0 ?
                  'No check has fallen due yet.' :
                  `${count(known)} of ${count(askable.length)} checks ` +
                      'answered' +
                      (waiting > 0 ? `, ${count(waiting)} asked anew` : '')}
                {failed && `. ${failed}`}
              </p>
              {due > MOST_CHECKS && (
                <p class="hint">
                  {count(due)} checks fell due up to this pose: candidates are
                  those of the last {count(MOST_CHECKS)}. The slider leads back
                  to earlier ones.
                </p>
              )}
              <Table label="Candidates" columns={columns} rows={shown}
                     keyOf={keyOf} empty="No candidates." />
              <Table label="Decisions" columns={DECISION_COLUMNS}
                     rows={decisions} keyOf={({name}) => name}
                     empty="Nobody has confirmed or rejected any." />
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
