// Deciding about a candidate: the buttons, their keys, and the way through the
// queue.
import {useEffect, useRef, useState} from 'preact/hooks';

import {type Found, keyOf} from '../data/candidates.js';
import {messageOf} from '../data/client.js';
import type {VehicleStore} from '../data/vehicle.js';
import {count} from '../parts/format.js';
import {go} from '../route.js';
import {decisionAbout, linkTo} from './drive.js';

interface Props {
  store: VehicleStore;
  found: Found;
  queue: Found[];
}

/** Confirm, reject, undo, and the way through the queue. */
export function DecisionPanel({store, found, queue}: Props) {
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
    void run(() => store.reject(candidate, note.current?.value ?? ''),
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
              count(decision.matchedSequence)}){
              decision.note ? `: ${decision.note}` : '.'}</>
        ) : 'Nobody has decided about this pair.'}
      </p>
      <label>
        Note, kept with the decision
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
