// Deciding about a pair: the buttons, their keys, and the way through the queue.
// Note and outcome belong to the pair, so that what comes late is told where it
// belongs, and nothing that was typed for one pair goes to another.
import {signal} from '@preact/signals';
import {useLayoutEffect, useRef} from 'preact/hooks';

import {type Found, pairOf} from '../data/candidates.js';
import {type Deed, type Decision, keyOfPair, type Pair, pairName} from
    '../data/decisions.js';
import type {VehicleStore} from '../data/vehicle.js';
import {count, instant, moment} from '../parts/format.js';
import {doIf, KeyedButtons} from '../parts/keyed_buttons.js';
import {useKeys} from '../parts/keys.js';
import {go} from '../route.js';
import {linkTo} from './drive.js';

const ADVANCE = 'revisit-advance';
const SHOWN_DEEDS = 6;

/** Whether a decision leads on to the next open pair. */
const advances = signal(localStorage.getItem(ADVANCE) === 'yes');

function setAdvances(on: boolean): void {
  advances.value = on;
  localStorage.setItem(ADVANCE, on ? 'yes' : 'no');
}

interface Props {
  store: VehicleStore;
  pair: Pair;
  queue: Found[];
}

/** The one that follows a pair in the queue, or goes before it; around the end,
 * if there is none. */
function neighbour(queue: Found[], pair: Pair, direction: 1|-1):
    Found|undefined {
  const others = queue.filter(
      found => keyOfPair(pairOf(found)) !== keyOfPair(pair));
  const order = (found: Found) => {
    const {query, matched} = pairOf(found);
    return query - pair.query || matched - pair.matched;
  };
  const sorted = [...others].sort((a, b) => {
    const [x, y] = [pairOf(a), pairOf(b)];
    return x.query - y.query || x.matched - y.matched;
  });
  const beyond = sorted.filter(other => direction * order(other) > 0);
  const around = beyond.length > 0 ? beyond : sorted;
  return direction > 0 ? around[0] : around[around.length - 1];
}

function DecisionLine({store, pair, decision}:
    {store: VehicleStore, pair: Pair, decision: Decision|undefined}) {
  if (!decision) return <>Nobody has decided about this pair.</>;
  const other = keyOfPair(decision) !== keyOfPair(pair);
  return (
    <>
      This pair is <strong>{decision.kind}</strong>
      {other && <> by what was said of <a href={store.addressOf(decision)}>
        {pairName(decision)}</a>, the same two places</>}
      {Number.isNaN(decision.time) ? '' :
        <>, <time dateTime={new Date(decision.time).toISOString()}>
          {instant(decision.time)}</time></>}
      {decision.by && <> by <code>{decision.by}</code></>}
      {decision.note ? `: ${decision.note}` : '.'}
    </>
  );
}

/** Shows what was done in this page, the last first, so that an answer that
 * comes late or not at all is seen from every pair. */
function Deeds({store, deeds}: {store: VehicleStore, deeds: Deed[]}) {
  if (deeds.length === 0) return null;
  return (
    <details class="deeds" open={deeds.some(({state}) => state === 'failed')}>
      <summary>{count(deeds.length)} done here</summary>
      <ol>
        {deeds.slice(-SHOWN_DEEDS).reverse().map(
            ({id, act, pair, state, text, time}) => (
          <li key={id} class={state === 'failed' ? 'error' : ''}>
            {moment(time)} <a href={store.addressOf(pair)}>
              {pairName(pair)}</a>: {state === 'under way' ?
                `${act}, no answer yet` : text}
          </li>
        ))}
      </ol>
    </details>
  );
}

/** Confirm, reject, undo, and the way through the queue. */
export function DecisionPanel({store, pair, queue}: Props) {
  const book = store.decisions;
  const key = keyOfPair(pair);
  const panel = useRef<HTMLElement>(null);
  const note = useRef<HTMLInputElement>(null);
  /** The pair at which `u` was pressed once, and the decision it named. */
  const asked = useRef(signal<{at: string, name: string}|undefined>(undefined))
                    .current;
  const decision = store.decisionAbout(pair);
  const last = book.lastMade();
  const busy = book.isBusy(key);
  const mayDecide = !decision && !busy;
  const outcome = book.lastAt(key);
  const isAsked = asked.value?.at === key && asked.value.name === last?.name;

  const step = (direction: 1|-1) => {
    const next = neighbour(queue, pair, direction);
    if (next) go(linkTo(store, next));
  };
  const decide = (act: 'confirm'|'reject') => {
    void book.decide(act, pair);
    if (advances.value) step(1);
  };
  const undo = () => {
    if (decision) {
      void book.undo(decision, key);
    } else if (last && isAsked) {
      asked.value = undefined;
      void book.undo(last, key);
    } else if (last) {
      asked.value = {at: key, name: last.name};
    }
  };

  useKeys({
    n: () => note.current?.focus(),
    a: () => setAdvances(!advances.value),
  }, pressed => {
    if (pressed !== 'u') asked.value = undefined;
  });
  // Another pair, another place for the focus: the next Tab leads to its note.
  // At once, since somebody who types fast may be in the note before a frame.
  useLayoutEffect(() => panel.current?.focus({preventScroll: true}), [key]);

  return (
    <section class="decision" aria-label="Decision" tabIndex={-1} ref={panel}>
      <p class="state-line">
        <DecisionLine store={store} pair={pair} decision={decision} />
      </p>
      <label>
        Note, kept with the decision about {pairName(pair)}
        {/* It takes the focus also while it takes no text: letters that are
            typed into it are never keys of the view. */}
        <input key={key} ref={note} type="text" name="note" maxLength={1024}
               value={book.drafts.notes.value.get(key) ?? ''}
               onInput={event => book.drafts.set(key,
                                                 event.currentTarget.value)}
               readOnly={!mayDecide} />
      </label>
      <KeyedButtons buttons={[
        {key: 'c', text: 'Confirm', looks: 'confirm',
         act: doIf(mayDecide, () => decide('confirm'))},
        {key: 'r', text: 'Reject', looks: 'reject',
         act: doIf(mayDecide, () => decide('reject'))},
        {key: 'u', text: !decision && last ? `Undo ${pairName(last)}…` : 'Undo',
         act: doIf(!busy && (decision ?? last) !== undefined, undo)},
        {key: 'k', text: 'Previous', act: doIf(queue.length > 0, () => step(-1))},
        {key: 'j', text: 'Next', act: doIf(queue.length > 0, () => step(1))},
      ]}>
        <label class="check">
          <input type="checkbox" checked={advances.value}
                 onChange={event => setAdvances(event.currentTarget.checked)} />
          Next one after a decision <kbd>a</kbd>
        </label>
      </KeyedButtons>
      <p role="status" class={outcome?.state === 'failed' ? 'error' : ''}>
        {isAsked && last && !decision ?
          `The last decision of this page is ${last.kind} ${pairName(last)
          }: u once more undoes it, any other key keeps it.` :
          outcome?.text ?? ''}
      </p>
      <p class="hint">
        {count(queue.length)} accepted candidates are open. <kbd>n</kbd> goes
        to the note, <kbd>Esc</kbd> leaves it.
      </p>
      <Deeds store={store} deeds={book.deeds.value} />
    </section>
  );
}
