// The columns of tables of candidates that tell how well a candidate is shown.
import {type Candidate, Verdict} from '../../gen/revisit/v1/candidate_pb.js';
import {verdictName} from '../data/candidates.js';
import {fixed, probability, words} from '../parts/format.js';
import type {Column} from '../parts/table.js';

export function evidenceColumns<Row extends {candidate: Candidate}>():
    Array<Column<Row>> {
  return [
    {title: 'Verdict', by: ({candidate}) => verdictName(candidate.verdict),
     cell: ({candidate: {verdict}}) => (
      <span class={`verdict ${words(Verdict[verdict]).replaceAll(' ', '-')}`}>
        {verdictName(verdict)}
      </span>)},
    {title: 'Probability', number: true,
     by: ({candidate}) => candidate.probability ?? NaN,
     cell: ({candidate}) => candidate.probability === undefined ?
         '–' : probability(candidate.probability)},
    {title: 'd² / gate', number: true,
     by: ({candidate: {gate}}) => gate ?
         gate.squaredMahalanobisDistance / gate.threshold : NaN,
     cell: ({candidate: {gate}}) => gate ?
         `${fixed(gate.squaredMahalanobisDistance, 2)} / ${
             fixed(gate.threshold, 2)}` : 'shape alone'},
  ];
}
