import {useEffect, useMemo, useRef, useState} from 'preact/hooks';

import {type Candidate, type CandidateSet, Direction, GateVerdict, Verdict}
    from '../../gen/revisit/v1/candidate_pb.js';
import {CovarianceForm} from '../../gen/revisit/v1/geometry_pb.js';
import {type Found, keyOf, verdictName} from '../data/candidates.js';
import {messageOf} from '../data/client.js';
import type {Graph} from '../data/graph.js';
import {type VehicleStore, vehicleStore} from '../data/vehicle.js';
import {type Curve, CurveView} from '../draw/curve.js';
import {MapView} from '../draw/map.js';
import {dots, type Scene, strokes} from '../draw/scene.js';
import {apply, fit} from '../geometry/rigid.js';
import {boxAround, type View} from '../geometry/view.js';
import {Export} from '../parts/export.js';
import {count, degrees, fixed, length, probability, words} from
    '../parts/format.js';
import {go} from '../route.js';
import {decisionAbout, linkTo, openQueue, posesToAsk} from './drive.js';

/** Nodes that are drawn before and behind the aligned ones. */
const CONTEXT_NODES = 25;

interface Evidence {
  rule: string;
  got: string;
  allowed: string;
  /** Undefined where the number alone decides nothing. */
  passed?: boolean;
  decided: boolean;
}

const MEANING: Record<Verdict, string> = {
  [Verdict.UNSPECIFIED]: 'no verdict',
  [Verdict.ACCEPTED]:
      'within the gates, and probable enough for a verifier to look',
  [Verdict.REJECTED_BY_GATE]:
      'the difference at the end is larger than the covariances allow, by ' +
      'itself and smoothed over the stretch',
  [Verdict.REJECTED_BY_SHAPE]:
      'the shapes differ, or speak for another place',
  [Verdict.AMBIGUOUS]:
      'another place is about as good: together they are probable enough, ' +
      'neither is alone',
  [Verdict.UNINFORMATIVE]:
      'so uncertain that no difference at all would not have spoken for it ' +
      'either',
  [Verdict.ILL_CONDITIONED]:
      'the covariance is not positive definite, so that nothing is decided',
};

function passedOf(verdict: GateVerdict): boolean|undefined {
  return verdict === GateVerdict.ILL_CONDITIONED ?
      undefined : verdict === GateVerdict.ACCEPTED;
}

/** Every number that a rule looked at, in the order of the rules. */
function evidenceOf(candidate: Candidate, acceptance: number): Evidence[] {
  const {gate, pathGate, verdict, shape} = candidate;
  const rejectedByPath = pathGate?.verdict === GateVerdict.REJECTED;
  const rows: Evidence[] = [{
    rule: 'Gate: squared distance at the end',
    got: `${fixed(gate!.squaredMahalanobisDistance, 2)} (p ${
        probability(gate!.pValue)})`,
    allowed: `≤ ${fixed(gate!.threshold, 2)} (${
        gate!.degreesOfFreedom} degrees of freedom)`,
    passed: passedOf(gate!.verdict),
    decided: verdict === Verdict.REJECTED_BY_GATE ||
        verdict === Verdict.ILL_CONDITIONED,
  }];
  if (pathGate) {
    rows.push({
      rule: 'The same, smoothed over the stretch',
      got: fixed(pathGate.endSquaredMahalanobisDistance, 2),
      allowed: `≤ ${fixed(gate!.threshold, 2)}`,
      passed: pathGate.endSquaredMahalanobisDistance <= gate!.threshold,
      decided: verdict === Verdict.REJECTED_BY_GATE,
    }, {
      rule: 'Path gate: squared distance of the stretch',
      got: `${fixed(pathGate.squaredMahalanobisDistance, 2)} (p ${
          probability(pathGate.pValue)})`,
      allowed: `≤ ${fixed(pathGate.threshold, 2)} (${
          fixed(pathGate.degreesOfFreedom, 1)} degrees of freedom)`,
      passed: passedOf(pathGate.verdict),
      decided: verdict === Verdict.REJECTED_BY_SHAPE && rejectedByPath,
    });
  }
  if (candidate.probability !== undefined) {
    rows.push({
      rule: 'Probability of this stretch of road',
      got: probability(candidate.probability),
      allowed: `≥ ${fixed(acceptance, 2)}`,
      passed: candidate.probability >= acceptance,
      decided: verdict === Verdict.ACCEPTED ||
          verdict === Verdict.UNINFORMATIVE,
    });
  }
  if (candidate.oddsToRunnerUp !== undefined) {
    const odds = candidate.oddsToRunnerUp;
    rows.push({
      rule: 'Odds to the next best place',
      got: `${odds > 1000 ? '> 1000' : odds < 0.1 ? '< 0.1' :
                                                    fixed(odds, 1)} : 1`,
      allowed: 'ambiguous within a factor of ten',
      decided: verdict === Verdict.AMBIGUOUS,
    });
  }
  if (shape) {
    rows.push({
      rule: 'Shape alone: log-likelihood ratio',
      got: `${fixed(shape.logLikelihoodRatio, 2)} over ${
          length(shape.overlapMeters)}`,
      allowed: '',
      decided: verdict === Verdict.REJECTED_BY_SHAPE && !rejectedByPath,
    });
  }
  return rows;
}

function deviations({difference}: Candidate):
    {x: number, y: number, heading: number} {
  const {form, values} = difference!.covariance!;
  const [yy, hh] = form === CovarianceForm.SPATIAL_10 ? [4, 9] : [3, 5];
  return {x: Math.sqrt(values[0]), y: Math.sqrt(values[yy]),
          heading: Math.sqrt(values[hh])};
}

function factsOf(candidate: Candidate): Array<[string, string]> {
  const {query, matched, difference, gate, placeInterval} = candidate;
  const deviation = deviations(candidate);
  return [
    ['Query', `pose ${count(query!.sequence)}, node ${count(query!.index)}`],
    ['Match', `pose ${count(matched!.sequence)}, node ${
        count(matched!.index)}`],
    ['Path between them', length(query!.travelledMeters -
                                 matched!.travelledMeters)],
    ['Direction', words(Direction[candidate.direction])],
    ['Difference x', `${fixed(difference!.xMeters, 2)} ± ${
        fixed(deviation.x, 2)} m`],
    ['Difference y', `${fixed(difference!.yMeters, 2)} ± ${
        fixed(deviation.y, 2)} m`],
    ['Difference of heading', `${degrees(difference!.headingRadians)} ± ${
        degrees(deviation.heading)}`],
    ['Deviations multiplied by', fixed(gate!.inflation, 2)],
    ...(placeInterval ? [[
      'Where to look', `from ${length(placeInterval.metersBefore)} before to ${
          length(placeInterval.metersAfter)} after the match`,
    ] as [string, string]] : []),
  ];
}

interface Overlay {
  scene: Scene;
  residuals: Curve;
}

/** Both passes, the recent one moved and turned so that it lies on the earlier
 * one as well as it can, and how far the pairs are apart then. */
function overlayOf(graph: Graph, candidate: Candidate): Overlay|undefined {
  const pairs = candidate.alignedPath.map(
      ({queryIndex, matchedIndex}) => [Number(queryIndex),
                                       Number(matchedIndex)]);
  if (pairs.length === 0 ||
      pairs.some(([q, m]) => q >= graph.size || m >= graph.size)) {
    return undefined;
  }
  const {x, y, heading, travelled} = graph;
  // Metres from the matched node, in which small differences are not lost.
  const [, end] = pairs[pairs.length - 1];
  const at = (i: number): [number, number] => [x[i] - x[end], y[i] - y[end]];
  const moved = fit(pairs.flatMap(([q]) => at(q)),
                    pairs.flatMap(([, m]) => at(m)));
  const movedAt = (i: number) => apply(moved, ...at(i));
  const path = (indices: number[], place: (i: number) => [number, number]) => {
    const least = Math.max(0, Math.min(...indices) - CONTEXT_NODES);
    const most = Math.min(graph.size - 1,
                          Math.max(...indices) + CONTEXT_NODES);
    const segments: number[] = [];
    for (let i = least; i < most; ++i) {
      if (graph.joined[i + 1]) segments.push(...place(i), ...place(i + 1));
    }
    return segments;
  };
  const matchedPath = path(pairs.map(([, m]) => m), at);
  const queryPath = path(pairs.map(([q]) => q), movedAt);
  const [lastQuery] = pairs[pairs.length - 1];
  const residuals = pairs.map(([q, m]) => {
    const [px, py] = movedAt(q);
    const [mx, my] = at(m);
    const [cosine, sine] = [Math.cos(heading[m]), Math.sin(heading[m])];
    return {
      back: travelled[q] - travelled[lastQuery],
      along: cosine * (px - mx) + sine * (py - my),
      across: -sine * (px - mx) + cosine * (py - my),
    };
  }).sort((a, b) => a.back - b.back);
  return {
    scene: {
      shapes: [
        strokes({id: 'pairs', label: 'Aligned pairs', colour: 'grid',
                 widthPixels: 1},
                pairs.flatMap(([q, m]) => [...movedAt(q), ...at(m)])),
        strokes({id: 'matched', label: 'Earlier pass',
                 colour: 'matched-path', widthPixels: 3}, matchedPath),
        strokes({id: 'query', label: 'This pass, laid over it',
                 colour: 'query-path', widthPixels: 2}, queryPath),
        dots({id: 'matched end', label: 'Match', colour: 'matched-path',
              radiusPixels: 6}, at(end)),
        dots({id: 'query end', label: 'Query', colour: 'query-path',
              radiusPixels: 4}, movedAt(lastQuery)),
      ],
      box: boxAround([...matchedPath, ...queryPath]),
    },
    residuals: {
      title: 'Residuals of the aligned pairs, m',
      xLabel: 'm from the query',
      x: residuals.map(({back}) => back),
      series: [
        {label: 'along the earlier pass', colour: 'path', as: 'line',
         values: residuals.map(({along}) => along)},
        {label: 'across it', colour: 'query-path', as: 'line',
         values: residuals.map(({across}) => across)},
      ],
    },
  };
}

function Posterior({store, found: {asked, set, candidate}}:
    {store: VehicleStore, found: Found}) {
  const places = set.candidates
      .filter(({probability: p}) => p !== undefined)
      .map(other => ({
        label: `pose ${count(other.matched!.sequence)}, ${
            verdictName(other.verdict)}`,
        link: linkTo(store, {asked, set, candidate: other}),
        value: other.probability!,
        current: other.rank === candidate.rank,
      }));
  if (places.length === 0) return null;
  return (
    <section>
      <h2>All places</h2>
      <ul class="posterior">
        {places.map(({label, link, value, current}) => (
          <li key={link}>
            <a href={link} aria-current={current ? 'true' : undefined}>
              {label}
            </a>
            <meter min={0} max={1} value={value} aria-label={label} />
            <span>{probability(value)}</span>
          </li>
        ))}
        {set.newPlaceProbability !== undefined && (
          <li>
            <span>a place not seen before</span>
            <meter min={0} max={1} value={set.newPlaceProbability}
                   aria-label="a place not seen before" />
            <span>{probability(set.newPlaceProbability)}</span>
          </li>
        )}
      </ul>
      <p class="hint">
        Two passes of one place count for each other, so that these may add up
        to more than 1.
      </p>
    </section>
  );
}

interface DecisionProps {
  store: VehicleStore;
  found: Found;
  queue: Found[];
}

/** Confirm, reject, undo, and the way through the queue. */
function DecisionPanel({store, found, queue}: DecisionProps) {
  const {candidate} = found;
  const note = useRef<HTMLInputElement>(null);
  const [status, setStatus] = useState('');
  const decision = decisionAbout(store, candidate);
  const last = store.decisions.value[store.decisions.value.length - 1];

  const run = async (work: () => Promise<void>, done: string) => {
    setStatus('…');
    try {
      await work();
      setStatus(done);
      if (note.current) note.current.value = '';
    } catch (error) {
      setStatus(messageOf(error));
    }
  };
  const confirm = () => {
    if (decision) return;
    void run(() => store.confirm(candidate, note.current?.value ?? ''),
             'Confirmed. Later searches build on it.');
  };
  const reject = () => {
    if (decision) return;
    void run(() => store.reject(candidate),
             'Rejected. It is not offered again.');
  };
  const undo = () => {
    const name = decision?.name ?? last?.name;
    if (name) void run(() => store.withdraw(name), 'Undone.');
  };
  const step = (direction: 1|-1) => {
    const others = queue.filter(other => keyOf(other) !== keyOf(found));
    const order = (a: Found, b: Found) =>
        a.asked - b.asked || a.candidate.rank - b.candidate.rank;
    const beyond = others.filter(other => direction * order(other, found) > 0);
    const around = beyond.length > 0 ? beyond : others;
    const next = direction > 0 ? around[0] : around[around.length - 1];
    if (next) go(linkTo(store, next));
  };

  const keys: Record<string, () => void> = {
    c: confirm,
    r: reject,
    u: undo,
    j: () => step(1),
    k: () => step(-1),
    n: () => note.current?.focus(),
  };
  const latest = useRef(keys);
  latest.current = keys;
  useEffect(() => {
    const onKey = (event: KeyboardEvent) => {
      const target = event.target as HTMLElement;
      if (event.key === 'Escape') target.blur();
      if (event.ctrlKey || event.metaKey || event.altKey ||
          target.closest('input, textarea, select, details')) {
        return;
      }
      const act = latest.current[event.key];
      if (!act) return;
      event.preventDefault();
      act();
    };
    addEventListener('keydown', onKey);
    return () => removeEventListener('keydown', onKey);
  }, []);

  return (
    <section class="decision" aria-label="Decision">
      <p class="state-line">
        {decision ? (
          <>This pair is <strong>{decision.kind}</strong> (poses {
              count(decision.querySequence)} and {
              count(decision.matchedSequence)}).</>
        ) : 'Nobody has decided about this pair.'}
      </p>
      <label>
        Note, kept with a confirmation
        <input ref={note} type="text" name="note" maxLength={1024}
               disabled={decision !== undefined} />
      </label>
      <div class="buttons">
        <button type="button" class="confirm" disabled={!!decision}
                onClick={confirm}>
          Confirm <kbd>c</kbd>
        </button>
        <button type="button" class="reject" disabled={!!decision}
                onClick={reject}>
          Reject <kbd>r</kbd>
        </button>
        <button type="button" disabled={!decision && !last} onClick={undo}>
          Undo <kbd>u</kbd>
        </button>
        <button type="button" disabled={queue.length === 0}
                onClick={() => step(-1)}>
          Previous <kbd>k</kbd>
        </button>
        <button type="button" disabled={queue.length === 0}
                onClick={() => step(1)}>
          Next <kbd>j</kbd>
        </button>
      </div>
      <p role="status">{status}</p>
      <p class="hint">
        {count(queue.length)} accepted candidates are open. <kbd>n</kbd> goes
        to the note, <kbd>Esc</kbd> leaves it.
      </p>
    </section>
  );
}

/** The candidate of this address, or how it was last if it is offered no
 * longer. */
function useFound(set: CandidateSet|undefined, asked: number,
                  matched: number): {found: Found|undefined, past: boolean} {
  const kept = useRef<Found>();
  const candidate = set?.candidates.find(
      ({matched: node}) => Number(node!.sequence) === matched);
  if (set && candidate) kept.current = {asked, set, candidate};
  const same = kept.current && keyOf(kept.current) === `${asked}-${matched}`;
  return {found: same ? kept.current : undefined,
          past: set !== undefined && !candidate};
}

interface Props {
  id: string;
  asked: number;
  matched: number;
}

export function CandidateView({id, asked, matched}: Props) {
  const store = vehicleStore(id);
  const graph = store.graph.value;
  const vehicle = store.vehicle.value;
  const checks = store.checks.value;
  const view = useRef<View>();
  useEffect(() => {
    const later = posesToAsk(checks, Infinity);
    store.candidates.want([asked, ...later.filter(pose => pose !== asked)]);
  }, [store, checks, asked]);
  const answer = store.candidates.answers.value.get(asked);
  const {found, past} = useFound(answer?.set, asked, matched);
  const queue = openQueue(store);
  const candidate = found?.candidate;
  const overlay = useMemo(
      () => graph && candidate && overlayOf(graph, candidate),
      [graph, candidate]);
  const evidence = candidate && evidenceOf(
      candidate, vehicle?.settings?.acceptanceProbability ?? NaN);
  const facts = candidate && factsOf(candidate);
  const title = `Pose ${count(candidate?.query?.sequence ?? asked)} at pose ${
      count(matched)}`;
  const name = vehicle?.displayName || id;
  return (
    <>
      <p class="crumbs">
        <a href={`/vehicles/${id}`}>{name}</a>
      </p>
      <div class="title">
        <h1>{title}</h1>
        {candidate && (
          <p>
            <span class={`verdict ${
                words(Verdict[candidate.verdict]).replaceAll(' ', '-')}`}>
              {verdictName(candidate.verdict)}
            </span>
            : {MEANING[candidate.verdict]}
          </p>
        )}
        {candidate && (
          <Export name={`${id}-${asked}-${matched}`} sheet={() => ({
            title: `${name}: ${title}, ${verdictName(candidate.verdict)}`,
            map: overlay && view.current &&
                {scene: overlay.scene, view: view.current},
            curves: overlay && [overlay.residuals],
            facts: [...evidence!.map(({rule, got, allowed}):
                        [string, string] => [rule, `${got}  ${allowed}`]),
                    ...facts!],
          })} />
        )}
      </div>
      {(store.error.value || answer?.error) && (
        <p class="error" role="status">
          {store.error.value ?? answer?.error}
        </p>
      )}
      {!answer && <p role="status">Asking the server…</p>}
      {past && (
        <p class="hint" role="status">
          The server no longer offers this pair at this pose
          {found ? '; what is shown is from before.' : '.'}
        </p>
      )}
      {found && <DecisionPanel store={store} found={found} queue={queue} />}
      {vehicle && (
        <p class="hint">
          Loop closures: {count(store.closures.value.length)}. Rejected:{' '}
          {count(store.rejections.value.length)}. Inflation estimated of them:
          {' '}{vehicle.consistency ?
                    fixed(vehicle.consistency.inflation, 2) : '–'}.
        </p>
      )}
      {candidate && (
        <div class="map-and-table">
          {overlay ? (
            <MapView scene={overlay.scene} viewRef={view}
                     label={'Both passes, laid over each other; the table ' +
                            'has the numbers'} />
          ) : (
            <p class="map">
              {candidate.alignedPath.length === 0 ?
                'The server sent no aligned path.' : 'Loading the path…'}
            </p>
          )}
          <div class="side">
            <table class="evidence">
              <caption>What the rules looked at</caption>
              <thead>
                <tr>
                  <th scope="col">Rule</th>
                  <th scope="col">Got</th>
                  <th scope="col">Allowed</th>
                  <th scope="col">Result</th>
                </tr>
              </thead>
              <tbody>
                {evidence!.map(({rule, got, allowed, passed, decided}) => (
                  <tr key={rule} class={decided ? 'decided' : ''}>
                    <th scope="row">{rule}</th>
                    <td>{got}</td>
                    <td>{allowed}</td>
                    <td>
                      {passed === undefined ? '' : passed ? 'passed' : 'failed'}
                      {decided && <strong> decided</strong>}
                    </td>
                  </tr>
                ))}
              </tbody>
            </table>
            <dl class="facts">
              {facts!.map(([label, value]) => (
                <div key={label}><dt>{label}</dt><dd>{value}</dd></div>
              ))}
            </dl>
            <Posterior store={store} found={found!} />
          </div>
        </div>
      )}
      {overlay && <CurveView key={`${asked}-${matched}`}
                             curve={overlay.residuals} />}
    </>
  );
}
