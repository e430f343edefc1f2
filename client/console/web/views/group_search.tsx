// A search in a group from one of its members, and what follows from it.
import {useEffect, useRef, useState} from 'preact/hooks';

import {type CandidateSet, EmptyReason} from
    '../../gen/revisit/v1/candidate_pb.js';
import type {GroupStore} from '../data/group.js';
import {type GroupFound, linkOf} from '../data/group_found.js';
import {linkName, placeName} from '../data/group_links.js';
import type {Asked, GroupSearch} from '../data/group_search.js';
import {count, probability, words} from '../parts/format.js';
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
  const link = linkOf(store.links.value, found);
  return !link ? '' : link.by ? `linked by ${link.by}` : 'linked';
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

/** A search, its candidates, and links made of them, by keyboard too. */
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
  const link = current && linkOf(store.links.value, current);
  const mayLink = current !== undefined && current.isAcross && !link && !busy;
  const outcome = store.outcome.value;

  const write = (at: string, note: string) =>
      setDrafts(before => new Map(before).set(at, note));
  const step = (direction: 1|-1) => {
    const at = found.indexOf(current) + direction;
    setUndoing(undefined);
    if (found[at]) setChosen(keyOfFound(found[at]));
  };
  const confirm = () => {
    if (!mayLink) return;
    setUndoing(undefined);
    void store.add(current.query, current.matched, drafts.get(key!) ?? '')
        .then(done => done && write(key!, ''));
  };
  // What others have linked is deleted in the table of links.
  const undo = () => {
    if (!last || busy) return;
    if (undoing !== last.name) {
      setUndoing(last.name);
      return;
    }
    setUndoing(undefined);
    void store.remove(last);
  };
  const show = () => {
    if (current && search.asked.value) {
      go(addressOf(current, search.asked.value));
    }
  };
  useKeys({
    j: () => step(1), k: () => step(-1), c: confirm, u: undo, Enter: show,
    n: () => note.current?.focus(),
  });
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
            <p class="state-line">
              {!current ? 'No candidate is chosen.' :
               !current.isAcross ? `${linkName(current)} is in the vehicle’s ` +
                   'own history: it is decided in its own view.' :
               `${linkName(current)}${link ? ': linked' : ''}`}
            </p>
            <label>
              Note, kept with the link
              <input key={key} ref={note} type="text" name="note" maxLength={1024}
                     value={key === undefined ? '' : drafts.get(key) ?? ''}
                     readOnly={!mayLink}
                     onInput={event =>
                       key && write(key, event.currentTarget.value)} />
            </label>
            <div class="buttons">
              <button type="button" class="confirm" disabled={!mayLink}
                      onClick={confirm}>
                Confirm <kbd>c</kbd>
              </button>
              <button type="button" disabled={!last || busy} onClick={undo}>
                {last ? `Undo ${linkName(last)}…` : 'Undo'} <kbd>u</kbd>
              </button>
              <button type="button" disabled={found.length === 0}
                      onClick={() => step(-1)}>
                Previous <kbd>k</kbd>
              </button>
              <button type="button" disabled={found.length === 0}
                      onClick={() => step(1)}>
                Next <kbd>j</kbd>
              </button>
              <button type="button" disabled={!current} onClick={show}>
                Open <kbd>Enter</kbd>
              </button>
            </div>
          </div>
        </>
      )}
      <p role="status" class={outcome?.failed ? 'error' : ''}>
        {undoing !== undefined && undoing === last?.name ?
          `The last link of this page is ${linkName(last)}: u once more ` +
              'deletes it.' :
          outcome?.text ?? ''}
      </p>
    </section>
  );
}
