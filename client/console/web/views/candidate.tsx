import {useEffect, useMemo, useRef} from 'preact/hooks';

import {type CandidateSet, Verdict} from
    '../../gen/revisit/v1/candidate_pb.js';
import {type Found, keyOf, pairOf, verdictName} from
    '../data/candidates.js';
import {type Pair, pairName} from '../data/decisions.js';
import {type VehicleStore, vehicleStore} from '../data/vehicle.js';
import {CurveView} from '../draw/curve.js';
import {MapView} from '../draw/map.js';
import type {MapSheet} from '../draw/svg.js';
import {Export} from '../parts/export.js';
import {type Fact, FactList} from '../parts/facts.js';
import {count, fixed, probability, words} from '../parts/format.js';
import {useTitle} from '../title.js';
import {DecisionPanel} from './candidate_decision.js';
import {alignedByDistance, alignedBySearch, overlayOf} from
    './candidate_overlay.js';
import {Locator, PairTable} from './candidate_pair.js';
import {evidenceOf, factsOf, MEANING, RuleTable} from './candidate_rules.js';
import {linkTo, openQueue, posesToAsk} from './drive.js';
import {areInOneFrame} from './recordings.js';

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

/** The candidate of this address, or how it was last if it is offered no
 * longer. */
function useFound(set: CandidateSet|undefined, asked: number,
                  matched: number): {found: Found|undefined, past: boolean} {
  const kept = useRef<Found>();
  const candidate = set?.candidates.find(
      ({matched: node}) => Number(node!.sequence) === matched);
  if (set && candidate) kept.current = {asked, set, candidate};
  const same = set && kept.current &&
      keyOf(kept.current) === `${asked}-${matched}`;
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
  const most = store.searches.value;
  const shown = useRef<MapSheet>();
  useEffect(() => {
    const later = posesToAsk(checks, Infinity, most);
    store.candidates.want(
        [asked, ...later.filter(pose => pose !== asked)], asked);
  }, [store, checks, asked, most]);
  const answer = store.candidates.answers.value.get(asked);
  const decided = store.decidedAt(asked, matched);
  const {found, past} = useFound(decided ? undefined : answer?.set, asked,
                                 matched);
  const queue = openQueue(store);
  const candidate = found?.candidate;
  const pair: Pair = decided ??
      (found ? pairOf(found) : store.pairAt(asked, matched));
  const sequenceLength = vehicle?.settings?.sequenceLengthMeters ?? 0;
  const recordings = store.recordings.value;
  const overlay = useMemo(() => {
    if (!graph) return undefined;
    const aligned = candidate ? alignedBySearch(graph, candidate) : [];
    return overlayOf(graph, aligned.length > 0 ? aligned :
        alignedByDistance(graph, pair, sequenceLength,
                          areInOneFrame(graph, recordings, pair)));
  }, [graph, recordings, candidate, pair.query, pair.matched,
      sequenceLength]);
  const evidence = candidate && evidenceOf(
      candidate, vehicle?.settings?.acceptanceProbability ?? NaN);
  const facts = candidate && factsOf(candidate, recordings);
  const title = `Pose ${count(pair.query)} at pose ${count(matched)}`;
  const name = vehicle?.displayName || id;
  useTitle(pairName(pair), name);
  return (
    <>
      <p class="crumbs">
        <a href={`/vehicles/${id}`}>{name}</a>{' '}
        {name !== id && <code>{id}</code>}
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
        <Export name={`${id}-${asked}-${matched}`} sheet={() => ({
          title: `${name}: ${title}${
              candidate ? `, ${verdictName(candidate.verdict)}` : ''}`,
          map: shown.current,
          curves: overlay && [overlay.residuals],
          facts: [...(evidence ?? []).map(({rule, got, allowed}):
                      Fact => [rule, `${got}  ${allowed}`]), ...facts ?? []],
        })} />
      </div>
      {(store.error.value || answer?.error) && (
        <p class="error" role="status">
          {store.error.value ?? answer?.error}
        </p>
      )}
      {graph && vehicle &&
        <DecisionPanel store={store} pair={pair} queue={queue} />}
      {!answer && !decided && <p role="status">Asking the server…</p>}
      {past && (
        <p class="hint" role="status">
          The server no longer offers this pair at this pose{found ?
            '; what the rules looked at is from before.' :
            ': it is drawn from the path alone, as far back as the sequence.'}
        </p>
      )}
      {vehicle && (
        <p class="hint">
          Loop closures: {count(store.decisions.closures.value.length)}.
          Rejected: {count(store.decisions.rejections.value.length)}. Inflation
          estimated of them: {vehicle.consistency ?
                    fixed(vehicle.consistency.inflation, 2) : '–'}.
        </p>
      )}
      <div class="map-and-table">
        <div>
          {overlay ? (
            <MapView scene={overlay.scene} shownRef={shown}
                     label={'Both passes, laid over each other; the table ' +
                            'has the numbers'} />
          ) : (
            <p class="map">
              {graph ? 'The vehicle keeps no path at these poses.' :
                       'Loading the path…'}
            </p>
          )}
          {overlay && <CurveView key={`${asked}-${matched}`}
                                 curve={overlay.residuals} />}
        </div>
        <div class="side">
          {graph && <PairTable store={store} graph={graph} pair={pair} />}
          {graph && graph.size > 0 &&
            <Locator graph={graph} recordings={recordings} pair={pair} />}
          {evidence && <RuleTable rows={evidence} />}
          {facts && <FactList facts={facts} />}
          {found && <Posterior store={store} found={found} />}
        </div>
      </div>
    </>
  );
}
