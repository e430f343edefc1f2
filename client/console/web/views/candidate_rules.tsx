// The numbers of a candidate, and those at which the rules looked.
import {type Candidate, Direction, GateVerdict, type PoseDifference,
        Verdict} from '../../gen/revisit/v1/candidate_pb.js';
import {CovarianceForm} from '../../gen/revisit/v1/geometry_pb.js';
import {FrameState} from '../../gen/revisit/v1/recording_pb.js';
import type {PlacedRecording} from '../data/recordings.js';
import type {Fact} from '../parts/facts.js';
import {count, degrees, fixed, length, probability, words} from
    '../parts/format.js';
import {tieText, titleOfMatch} from './recordings.js';

export interface Evidence {
  rule: string;
  got: string;
  allowed: string;
  /** Undefined where the number alone decides nothing. */
  passed?: boolean;
  decided: boolean;
}

export const MEANING: Record<Verdict, string> = {
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
export function evidenceOf(candidate: Candidate, acceptance: number):
    Evidence[] {
  const {gate, pathGate, verdict, shape} = candidate;
  const rejectedByPath = pathGate?.verdict === GateVerdict.REJECTED;
  const rows: Evidence[] = [gate ? {
    rule: 'Gate: squared distance at the end',
    got: `${fixed(gate.squaredMahalanobisDistance, 2)} (p ${
        probability(gate.pValue)})`,
    allowed: `≤ ${fixed(gate.threshold, 2)} (${
        gate.degreesOfFreedom} degrees of freedom)`,
    passed: passedOf(gate.verdict),
    decided: verdict === Verdict.REJECTED_BY_GATE ||
        verdict === Verdict.ILL_CONDITIONED,
  } : {
    rule: 'Gate: squared distance at the end',
    got: 'not known, since nothing ties the frames of both poses',
    allowed: 'the shape alone is compared',
    decided: false,
  }];
  if (pathGate && gate) {
    rows.push({
      rule: 'The same, smoothed over the stretch',
      got: fixed(pathGate.endSquaredMahalanobisDistance, 2),
      allowed: `≤ ${fixed(gate.threshold, 2)}`,
      passed: pathGate.endSquaredMahalanobisDistance <= gate.threshold,
      decided: verdict === Verdict.REJECTED_BY_GATE,
    });
  }
  if (pathGate) {
    rows.push({
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

function deviations({covariance}: PoseDifference):
    {x: number, y: number, heading: number} {
  const {form, values} = covariance!;
  const [yy, hh] = form === CovarianceForm.SPATIAL_10 ? [4, 9] : [3, 5];
  return {x: Math.sqrt(values[0]), y: Math.sqrt(values[yy]),
          heading: Math.sqrt(values[hh])};
}

function differenceFacts(difference: PoseDifference|undefined): Fact[] {
  if (!difference) {
    return [['Difference', 'not known: nothing ties the frames of both poses']];
  }
  const deviation = deviations(difference);
  return [
    ['Difference x', `${fixed(difference.xMeters, 2)} ± ${
        fixed(deviation.x, 2)} m`],
    ['Difference y', `${fixed(difference.yMeters, 2)} ± ${
        fixed(deviation.y, 2)} m`],
    ['Difference of heading', `${degrees(difference.headingRadians)} ± ${
        degrees(deviation.heading)}`],
  ];
}

/** The numbers of a candidate of a vehicle with these recordings. */
export function factsOf(candidate: Candidate,
                        recordings: readonly PlacedRecording[]): Fact[] {
  const {query, matched, difference, gate, placeInterval} = candidate;
  const isWithinOne = recordings.length === 0 ||
      candidate.frameState === FrameState.SAME;
  return [
    ['Query', `pose ${count(query!.sequence)}, node ${count(query!.index)}`],
    ['Match', `pose ${count(matched!.sequence)}, node ${
        count(matched!.index)}`],
    ['Path between them', length(query!.travelledMeters -
                                 matched!.travelledMeters) +
        (isWithinOne ? '' : ', without what lies between recordings')],
    ['Direction', words(Direction[candidate.direction])],
    ...recordings.length > 0 ? [
      ['Recording of the match', titleOfMatch(recordings, candidate)],
      ['Frames', tieText(candidate)],
    ] as Fact[] : [],
    ...differenceFacts(difference),
    ...gate ? [['Deviations multiplied by', fixed(gate.inflation, 2)] as Fact] :
              [],
    ...(placeInterval ? [[
      'Where to look', `from ${length(placeInterval.metersBefore)} before to ${
          length(placeInterval.metersAfter)} after the match`,
    ] as Fact] : []),
  ];
}

/** Rules with their numbers, and which of them decided. */
export function RuleTable({rows}: {rows: Evidence[]}) {
  return (
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
        {rows.map(({rule, got, allowed, passed, decided}) => (
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
  );
}
