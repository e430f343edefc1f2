// A search in a group from one of its members, and what is decided about its
// candidates.
import {useEffect, useRef, useState} from 'preact/hooks';

import {type CandidateSet, EmptyReason} from
    '../../gen/revisit/v1/candidate_pb.js';
import type {GroupStore} from '../data/group.js';
import {decisionOf, type GroupFound} from '../data/group_found.js';
import {type GroupDecision, placeName, posesName} from
    '../data/group_links.js';
import type {Asked, GroupSearch} from '../data/group_search.js';
import {count, probability, words} from '../parts/format.js';
import {doIf, KeyedButtons} from '../parts/keyed_buttons.js';
import {useKeys} from '../parts/keys.js';
import {type Column, Table} from '../parts/table.js';
import {go} from '../route.js';
import {evidenceColumns} from './candidate_columns.js';
import {tieText} from './recordings.js';

/** The key of a candidate's row. */
export function keyOfFound({query, matched, candidate}: GroupFound): string {
  return `${placeName(query)} ${placeName(matched)} ${candidate.rank}`;
}

/** Where a candidate is looked at: one of the vehicle's own in its own view,
 * another where its match lies. */
function addressOf({query, matched, isAcross}: GroupFound, asked: Asked):
    string {
  return isAcross ?
      `/vehicles/${matched.vehicle}?at=${matched.sequence}` :
      `/vehicles/${query.vehicle}/candidates/${
          asked.sequence || query.sequence}-${matched.sequence}`;
}

function stateText(store: GroupStore, found: GroupFound): string {
  if (!found.isAcross) return 'its own';
  const made = decisionOf(store.decisions.value, found);
  return !made ? '' : made.by ? `${made.kind} by ${made.by}` : made.kind;
}

function columnsFor(store: GroupStore, asked: Asked):
    Array<Column<GroupFound>> {
  return [
    {title: 'Rank', number: true, by: ({candidate}) => candidate.rank,
     cell: ({candidate}) => candidate.rank},
    {title: 'Vehicle', by: ({matched}) => matched.vehicle,
     cell: found => (
      <a href={addressOf(found, asked)}
         aria-label={`${found.isAcross ? '' : 'itself, '}${
             placeName(found.query)} at ${placeName(found.matched)}`}>
        {found.isAcross ? found.matched.vehicle : 'itself'}
      </a>)},
    {title: 'Match', number: true, by: ({matched}) => matched.sequence,
     cell: ({matched}) => count(matched.sequence)},
    ...evidenceColumns(),
    {title: 'Frames', by: ({candidate}) => tieText(candidate),
     cell: ({candidate}) => tieText(candidate)},
    {title: 'State', by: found => stateText(store, found),
     cell: found => stateText(store, found)},
  ];
}

/** What was searched, for people. */
function searchedText(set: CandidateSet): string {
  const nodes = set.searched.reduce((sum, {nodeCount}) => sum + nodeCount, 0n);
  const others = set.searched.length;
  return `Searched the histories of ${count(others)} other ${
      others === 1 ? 'vehicle' : 'vehicles'} with ${count(nodes)} nodes${
      set.unsearched.length > 0 ?
          `, and not those of ${count(set.unsearched.length)}, as the members ` +
              'say' : ''}${
      set.newPlaceProbability === undefined ? '' :
          `. A place not seen before: ${
              probability(set.newPlaceProbability)}`}.`;
}

interface Props {
  store: GroupStore;
  search: GroupSearch;
  members: readonly string[];
  /** What the address asks for; undefined for nothing. */
  asked: Asked|undefined;
  found: GroupFound[];
  onAsk: (asked: Asked) => void;
  pointed: string|undefined;
  onPoint: (key: string|undefined) => void;
}

/** Says what to search for; Enter searches. */
function Form({members, asked, onAsk}: Pick<Props, 'members'|'asked'|'onAsk'>) {
  const [vehicle, setVehicle] = useState(asked?.vehicle ?? members[0] ?? '');
  const [pose, setPose] = useState(asked?.sequence ? `${asked.sequence}` : '');
  const [excludeOwn, setExcludeOwn] = useState(asked?.excludeOwn ?? false);
  useEffect(() => {
    if (!asked) return;
    setVehicle(asked.vehicle);
    setPose(asked.sequence ? `${asked.sequence}` : '');
    setExcludeOwn(asked.excludeOwn);
  }, [asked]);
  // An address may name one that is not, or no longer, a member.
  const listed = vehicle && !members.includes(vehicle) ?
      [vehicle, ...members] : members;
  return (
    <form class="filters" role="search" aria-label="Search in this group"
          onSubmit={event => {
            event.preventDefault();
            onAsk({vehicle: vehicle || listed[0], sequence: Number(pose),
                   excludeOwn});
          }}>
      <label>
        From vehicle
        <select name="vehicle" value={vehicle || listed[0]}
                onChange={event => setVehicle(event.currentTarget.value)}>
          {listed.map(id => <option key={id} value={id}>{id}</option>)}
        </select>
      </label>
      <label>
        At pose
        <input type="number" name="pose" min={1} step={1} value={pose}
               placeholder="newest"
               onInput={event => setPose(event.currentTarget.value)} />
      </label>
      <label class="check">
        <input type="checkbox" checked={excludeOwn}
               onChange={event =>
                 setExcludeOwn(event.currentTarget.checked)} />
        in others only
      </label>
      <button type="submit" disabled={listed.length === 0}>
        Search in this group
      </button>
    </form>
  );
}

/** The panel's line about the candidate that is chosen. */
function stateLine(store: GroupStore, current: GroupFound|undefined): string {
  if (!current) return 'No candidate is chosen.';
  const name = posesName(current);
  if (!current.isAcross) {
    return `${name} is in the vehicle’s own history: it is decided in its own ` +
        'view.';
  }
  const state = stateText(store, current);
  return state ? `${name}: ${state}` : name;
}

/** A search, its candidates, and decisions about them, by keyboard too. */
export function SearchPanel(
    {store, search, members, asked, found, onAsk, pointed, onPoint}: Props) {
  const note = useRef<HTMLInputElement>(null);
  const [chosen, setChosen] = useState<string>();
  /** Notes that are being written, by candidate. */
  const [drafts, setDrafts] = useState<ReadonlyMap<string, string>>(new Map());
  const [undoing, setUndoing] = useState<string>();
  const set = search.set.value;
  const current = found.find(one => keyOfFound(one) === chosen) ?? found[0];
  const key = current && keyOfFound(current);
  const busy = store.isBusy.value;
  const last = store.lastMade();
  const mayDecide = current !== undefined && current.isAcross && !busy &&
      !decisionOf(store.decisions.value, current);
  const outcome = store.outcome.value;

  const write = (at: string, note: string) =>
      setDrafts(before => new Map(before).set(at, note));
  const step = (direction: 1|-1) => {
    const at = found.indexOf(current) + direction;
    setUndoing(undefined);
    if (found[at]) setChosen(keyOfFound(found[at]));
  };
  const decide = (kind: GroupDecision['kind']) => {
    setUndoing(undefined);
    void store.decide(kind, current, drafts.get(key!) ?? '')
        .then(done => done && write(key!, ''));
  };
  // Decisions of others are deleted in their tables.
  const undo = (made: GroupDecision) => {
    if (undoing !== made.name) {
      setUndoing(made.name);
      return;
    }
    setUndoing(undefined);
    void store.remove(made);
  };
  useKeys({n: () => note.current?.focus()});
  return (
    <section aria-label="Search">
      <h2>Search in this group</h2>
      <Form members={members} asked={asked} onAsk={onAsk} />
      {search.error.value &&
        <p class="error" role="status">{search.error.value}</p>}
      {search.asked.value && (
        <p class="hint" role="status">
          {!set ? search.error.value ? '' : 'Searching…' : searchedText(set)}
          {set && search.isUnderWay.value &&
            ' The server is reading the others; the search is made again.'}
        </p>
      )}
      {set && search.asked.value && (
        <>
          <Table label="Candidates"
                 columns={columnsFor(store, search.asked.value)} rows={found}
                 keyOf={keyOfFound} onPick={setChosen}
                 current={key}
                 rowClass={one => one === current ? 'chosen' : ''}
                 pointed={pointed} onPoint={onPoint}
                 empty={`No candidates: ${
                     words(EmptyReason[set.emptyReason])}.`} />
          <div class="decision" role="group" aria-label="Decision">
            <p class="state-line">{stateLine(store, current)}</p>
            <label>
              Note, kept with the decision
              <input key={key} ref={note} type="text" name="note" maxLength={1024}
                     value={key === undefined ? '' : drafts.get(key) ?? ''}
                     readOnly={!mayDecide}
                     onInput={event =>
                       key && write(key, event.currentTarget.value)} />
            </label>
            <KeyedButtons buttons={[
              {key: 'c', text: 'Confirm', looks: 'confirm',
               act: doIf(mayDecide, () => decide('linked'))},
              {key: 'r', text: 'Reject', looks: 'reject',
               act: doIf(mayDecide && !store.isWithoutRejections.value,
                         () => decide('rejected'))},
              {key: 'u', text: last ? `Undo ${posesName(last)}…` : 'Undo',
               act: last && !busy ? () => undo(last) : undefined},
              {key: 'k', text: 'Previous',
               act: doIf(found.length > 0, () => step(-1))},
              {key: 'j', text: 'Next',
               act: doIf(found.length > 0, () => step(1))},
              {key: 'Enter', text: 'Open',
               act: doIf(current !== undefined, () =>
                 go(addressOf(current, search.asked.value!)))},
            ]} />
          </div>
        </>
      )}
      <p role="status" class={outcome?.failed ? 'error' : ''}>
        {undoing !== undefined && undoing === last?.name ?
          `The last decision of this page is ${last.kind} ${posesName(last)
          }: u once more deletes it.` :
          outcome?.text ?? ''}
      </p>
    </section>
  );
}
