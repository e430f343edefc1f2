// All candidates of stored checks about which nobody has decided, as they come,
// to be worked through by keyboard.
import {useEffect, useLayoutEffect, useMemo, useRef} from 'preact/hooks';

import {type Candidate, Verdict} from '../../gen/revisit/v1/candidate_pb.js';
import {CandidateCause, CandidateState} from
    '../../gen/revisit/v1/check_pb.js';
import {verdictName} from '../data/candidates.js';
import {follow, isContradicted, isOpen, neighbour, type Order, ordered,
        otherVehicleOf, posesOf, type Waiting} from '../data/queue.js';
import {deeds, isBusy, lastDecision, nameOf, type QueueDeed, readOnly,
        subjectOf} from '../data/queue_deeds.js';
import {MOST_WAITING, type QueueFilter, QueueStore} from
    '../data/queue_store.js';
import {Export} from '../parts/export.js';
import {count, fixed, length, moment, probability, words} from
    '../parts/format.js';
import {doIf, KeyedButtons} from '../parts/keyed_buttons.js';
import {type Column, Table} from '../parts/table.js';
import {go, query, setQuery} from '../route.js';
import {useTitle} from '../title.js';

const SHOWN_DEEDS = 6;
/** A file has no more of them. */
const MOST_SAVED = 200;

/** What the address asks for: what it does not say, or says in other words than
 * the page writes, is as if it were left out. */
function filterOf(parameters: URLSearchParams): QueueFilter {
  const least = Number(parameters.get('least'));
  return {vehicle: parameters.get('vehicle') || undefined,
          leastProbability: least >= 0 && least <= 1 ? least : 0,
          byValue: orderOf(parameters) === 'value'};
}

function orderOf(parameters: URLSearchParams): Order {
  const order = parameters.get('order');
  return order === 'newest' || order === 'probable' ? order : 'value';
}

/** Where a candidate is looked at: in its own view, by the pose at which its check
 * was due, or in another vehicle where its match lies. */
function addressOf(one: Waiting): string {
  const {matched} = posesOf(one);
  return otherVehicleOf(one) !== undefined ?
      `/vehicles/${matched.vehicle}?at=${matched.sequence}` :
      `/vehicles/${one.vehicle}/candidates/${one.asked}-${matched.sequence}`;
}

function matchText(one: Waiting): string {
  const other = otherVehicleOf(one);
  const sequence = count(one.evidence.matched!.sequence);
  return other === undefined ? sequence : `${sequence} in ${other}`;
}

/** What an open candidate is called in the address of the page. */
function placeOf({name}: Waiting): string {
  const [, vehicle, , asked, , number] = name.split('/');
  return [vehicle, asked, number].join('/');
}

function probabilityText({evidence: {probability: p}}: Waiting): string {
  return p === undefined ? '–' : probability(p);
}

/** A value in square metres: of a small one, how small it is. */
function valueText({value}: Waiting): string {
  return value > 0 && value < 0.001 ? '< 0.001 m²' : `${fixed(value, 3)} m²`;
}

/** Why an open candidate is to be looked at otherwise than as it was found. */
function markOf(one: Waiting): string {
  const cause = isContradicted(one) ? 'contradicted' :
      one.cause === CandidateCause.SEARCH ? 'found by a later search' : '';
  return [cause, one.isStale ? 'stale' : ''].filter(mark => mark).join(', ');
}

/** What has become of a candidate, and who has decided. */
function stateText(one: Waiting): string {
  if (isOpen(one)) return markOf(one);
  const state = words(CandidateState[one.state]);
  if (one.state === CandidateState.WITHDRAWN) {
    return one.cause === CandidateCause.RETENTION ?
        `${state}: kept no longer` :
        one.cause === CandidateCause.SEARCH ?
        `${state}: less probable now` : state;
  }
  const made = deeds.value.find(
      ({act, made: name}) => act !== 'undo' && name === one.decision);
  if (made) {
    if (made.at !== one.key) return `${state} with ${nameOf(made.candidate)}`;
    return one.left === undefined ? `${state} here, the server follows` :
                                    `${state} here`;
  }
  return one.actor ? `${state} by ${one.actor}` : `${state} elsewhere`;
}

function columnsFor(names: ReadonlyMap<string, string>):
    Array<Column<Waiting>> {
  return [
    {title: 'Pose', number: true, cell: one => (
      <a href={addressOf(one)} aria-label={`${
          count(one.evidence.query!.sequence)} at pose ${matchText(one)} of ${
          one.vehicle}`}>
        {count(one.evidence.query!.sequence)}
      </a>)},
    {title: 'Match', number: true, cell: matchText},
    {title: 'Vehicle', cell: ({vehicle}) => (
      <a href={`/vehicles/${vehicle}`}>{names.get(vehicle) || vehicle}</a>)},
    {title: 'Verdict', cell: ({evidence: {verdict}}) => (
      <span class={`verdict ${words(Verdict[verdict]).replaceAll(' ', '-')}`}>
        {verdictName(verdict)}
      </span>)},
    {title: 'Probability', number: true, cell: probabilityText},
    {title: 'Value', number: true, cell: valueText},
    {title: 'd² / gate', number: true, cell: ({evidence: {gate}}) => gate ?
       `${fixed(gate.squaredMahalanobisDistance, 2)} / ${
           fixed(gate.threshold, 2)}` : 'shape alone'},
    {title: 'Runs together', number: true, cell: ({evidence: {shape}}) =>
       shape ? length(shape.overlapMeters) : '–'},
    {title: 'Found', cell: ({found}) => (
      <time dateTime={new Date(found).toISOString()}>{moment(found)}</time>)},
    {title: 'State', cell: one =>
       isBusy(one.key) ? 'no answer yet' : stateText(one)},
  ];
}

/** What was told when the candidate was found, beside what is found now. */
function Searches({one}: {one: Waiting}) {
  if (!one.isSearchedAgain) return null;
  const found = [one.told, one.evidence];
  const rows: Array<[string, (candidate: Candidate) => string]> = [
    ['Probability', ({probability: p}) => p === undefined ? '–' :
                                                            probability(p)],
    ['Verdict', ({verdict}) => verdictName(verdict)],
    ['Match', ({matched}) => count(matched!.sequence)],
    ['Difference', ({difference}) => difference ? length(Math.hypot(
        difference.xMeters, difference.yMeters)) : '–'],
  ];
  return (
    <table class="searches" aria-label="Both searches">
      <thead>
        <tr>
          <th scope="col" />
          <th scope="col">Told then</th>
          <th scope="col">Found now</th>
        </tr>
      </thead>
      <tbody>
        {rows.map(([title, cell]) => (
          <tr key={title}>
            <th scope="row">{title}</th>
            {found.map((candidate, i) => (
              <td key={i}>{candidate ? cell(candidate) : 'nothing'}</td>))}
          </tr>
        ))}
      </tbody>
    </table>
  );
}

/** What makes the decision about this one another one than usual. */
function Marks({one}: {one: Waiting}) {
  return (
    <>
      {isContradicted(one) && (
        <p class="hint">
          Contradicted: the loop closure that confirmed it says something else
          than others that agree with each other. To uphold it keeps it, to reject
          the candidate deletes it.
        </p>
      )}
      {isOpen(one) && one.isStale && (
        <p class="hint">
          Stale: what this rests on has changed, and it waits to be searched
          again.
        </p>
      )}
    </>
  );
}

/** What was done in the queue since the page was loaded, the last first. */
function Deeds({done}: {done: readonly QueueDeed[]}) {
  if (done.length === 0) return null;
  return (
    <details class="deeds" open={done.some(({state}) => state === 'failed')}>
      <summary>{count(done.length)} done here</summary>
      <ol>
        {done.slice(-SHOWN_DEEDS).reverse().map(
            ({id, act, candidate, state, text, time}) => (
          <li key={id} class={state === 'failed' ? 'error' : ''}>
            {moment(time)} <a href={addressOf(candidate)}>
              {nameOf(candidate)}</a>: {state === 'under way' ?
                `${act}, no answer yet` : text}
          </li>
        ))}
      </ol>
    </details>
  );
}

/** The row that is looked at, which the address names, and how to look at
 * another one, or at one that is not yet shown. */
function useSelection(rows: readonly Waiting[]|undefined, named: string|null):
    [Waiting|undefined, (key: string|undefined) => void,
     (awaited: string|undefined) => void] {
  const selected = useRef<string>();
  const before = useRef<string[]>([]);
  const awaited = useRef<string>();
  if (rows) {
    selected.current ??= rows.find(one => placeOf(one) === named)?.key;
    const come = rows.find(
        one => one.key === awaited.current && isOpen(one));
    if (come) {
      selected.current = come.key;
      awaited.current = undefined;
    }
    selected.current = follow(selected.current, before.current, rows);
    before.current = rows.map(({key}) => key);
  }
  const current = rows?.find(({key}) => key === selected.current);
  const place = current && placeOf(current);
  // At once, as the keys: the address never lags behind what is marked.
  useLayoutEffect(() => {
    if (rows && place !== (named ?? undefined)) setQuery('at', place);
  }, [rows === undefined, place]);
  const select = (key: string|undefined) => {
    const one = rows?.find(other => other.key === key);
    if (!one) return;
    awaited.current = undefined;
    selected.current = key;
    setQuery('at', placeOf(one));
  };
  return [current, select, key => awaited.current = key];
}

function Filters({store, filter, order}:
    {store: QueueStore, filter: QueueFilter, order: Order}) {
  const known = store.vehicles.value.map(({name, displayName}) => {
    const id = name.replace('vehicles/', '');
    return {id, title: displayName && displayName !== id ?
        `${displayName} (${id})` : id};
  });
  // An address may name one that is not, or not yet, among them.
  const {vehicle} = filter;
  const listed = vehicle && !known.some(({id}) => id === vehicle) ?
      [{id: vehicle, title: vehicle}, ...known] : known;
  return (
    <form class="filters" role="search" onSubmit={e => e.preventDefault()}>
      <label>
        Vehicle
        <select value={vehicle ?? ''} onChange={event =>
                  setQuery('vehicle', event.currentTarget.value || undefined)}>
          <option value="">all</option>
          {listed.map(({id, title}) => (
            <option key={id} value={id}>{title}</option>))}
        </select>
      </label>
      <label>
        Least probability
        <input type="number" name="least" min={0} max={1} step="any"
               value={filter.leastProbability || ''} placeholder="any"
               onChange={event => setQuery(
                   'least', event.currentTarget.value || undefined)} />
      </label>
      <label>
        Order
        <select value={order} onChange={event => setQuery(
                  'order', event.currentTarget.value === 'value' ?
                      undefined : event.currentTarget.value)}>
          <option value="value">most valuable first</option>
          <option value="newest">newest first</option>
          <option value="probable">most probable first</option>
        </select>
      </label>
    </form>
  );
}

/** How many checks are still to be made; undefined where nothing tells. */
function owedChecks(store: QueueStore): bigint|undefined {
  const debts = store.vehicles.value.map(({checkDebt}) => checkDebt)
                    .filter(debt => debt !== undefined);
  return debts.length === 0 ? undefined :
                              debts.reduce((sum, debt) => sum + debt, 0n);
}

export function QueueView() {
  const store = useMemo(() => new QueueStore(), []);
  useEffect(() => () => store.close(), []);
  const filter = filterOf(query.value);
  const order = orderOf(query.value);
  useEffect(() => store.show(filter),
            [filter.vehicle, filter.leastProbability, filter.byValue]);
  useTitle('Queue');
  const all = store.waiting.value;
  const rows = useMemo(() => all && ordered(all, order), [all, order]);
  const vehicles = store.vehicles.value;
  const columns = useMemo(
      () => columnsFor(new Map(vehicles.map(({name, displayName}) =>
          [name.replace('vehicles/', ''), displayName]))),
      [vehicles]);
  const [current, select, expect] =
      useSelection(rows, query.value.get('at'));
  const done = deeds.value;
  const last = lastDecision();
  const outcome = done.at(-1);
  const open = (rows ?? []).filter(isOpen);
  const owed = owedChecks(store);
  const mayDecide = current !== undefined && isOpen(current) &&
      !isBusy(current.key) && !readOnly.value.has(subjectOf(current));

  const step = (direction: 1|-1) =>
      select(neighbour(rows ?? [], current?.key, direction));
  const decide = (act: 'confirm'|'reject') => {
    if (!current) return;
    store.decide(act, current);
    const below = neighbour(rows!, current.key, 1);
    select(below === current.key ? neighbour(rows!, current.key, -1) : below);
  };
  return (
    <>
      <div class="title">
        <h1>Queue</h1>
        <p role="status">
          {rows ? `${count(open.length)}${store.isCut.value ? ' and more' : ''
                  } open${store.isLive.value ? '' : ', as of before'}` :
                  'Asking the server…'}
        </p>
        {owed !== undefined && (
          <p>{count(owed)} {owed === 1n ? 'check' : 'checks'} owed</p>)}
        <Export name="queue" sheet={() => ({
          title: `Queue: ${count(open.length)} open`,
          facts: open.slice(0, MOST_SAVED).map(one => [
            nameOf(one),
            `${verdictName(one.evidence.verdict)}, ${probabilityText(one)}, ${
                valueText(one)}`]),
        })} />
      </div>
      {store.error.value && <p class="error" role="status">
        {store.error.value}</p>}
      <Filters store={store} filter={filter} order={order} />
      <Table label="Open candidates" columns={columns} rows={rows ?? []}
             keyOf={({key}) => key} current={current?.key} onPick={select}
             rowClass={one => `${one.key === current?.key ? 'chosen ' : ''}${
                 isOpen(one) ? '' : 'leaving'}`}
             empty={!rows ? '' : vehicles.length > 0 ?
               'Nothing waits for a decision.' :
               'There is no vehicle with stored checks that you may read.'} />
      <section class="decision" aria-label="Decision">
        <p class="state-line">
          {current ? (
            <>
              <a href={addressOf(current)}>{nameOf(current)}</a>
              {isOpen(current) ? '' : `: ${stateText(current)}`}
            </>
          ) : 'No candidate is chosen.'}
        </p>
        {current && <Searches one={current} />}
        {current && <Marks one={current} />}
        <KeyedButtons buttons={[
          {key: 'c', looks: 'confirm',
           text: current && isContradicted(current) ? 'Uphold' : 'Confirm',
           act: doIf(mayDecide, () => decide('confirm'))},
          {key: 'r', text: 'Reject', looks: 'reject',
           act: doIf(mayDecide, () => decide('reject'))},
          {key: 'u', text: last ? `Undo ${nameOf(last.candidate)}` : 'Undo',
           act: doIf(last !== undefined, () => expect(store.undo()?.at))},
          {key: 'k', text: 'Previous', act: doIf(open.length > 0, () => step(-1))},
          {key: 'j', text: 'Next', act: doIf(open.length > 0, () => step(1))},
          {key: 'Enter', text: 'Open',
           act: doIf(current !== undefined, () => go(addressOf(current!)))},
        ]} />
        <p role="status" class={outcome?.state === 'failed' ? 'error' : ''}>
          {outcome?.text ?? ''}
        </p>
        {current && readOnly.value.has(subjectOf(current)) && (
          <p class="hint">
            You may read {subjectOf(current)}, but not decide about it.
          </p>
        )}
        <Deeds done={done} />
      </section>
      {store.isCut.value && (
        <p class="hint">
          More than {count(MOST_WAITING)} are open. A vehicle or a least
          probability shows others; else they come once half of these are
          decided.
        </p>
      )}
      <p class="hint">
        What the checks of vehicles with stored checks have found. A candidate
        that somebody decides is shown for some seconds more, with who did.
      </p>
    </>
  );
}
