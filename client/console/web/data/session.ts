// Who is signed in at the issuer, where the console knows one.
import {computed, effect, signal} from '@preact/signals';

import {SESSION_PATH, SIGN_IN_PATH, SIGN_OUT_PATH} from
    '../../shared/addresses.js';
import {connection} from './client.js';
import {consoleSettings} from './console.js';

export interface User {
  subject: string;
  name: string;
}

/** Null for nobody. */
export const user = signal<User|null>(null);

/** Where signing in begins that comes back to the view at hand. */
export function signInAddress(): string {
  const here = location.pathname + location.search;
  return `${SIGN_IN_PATH}?to=${encodeURIComponent(here)}`;
}

/** Leaves the page. Throws if the console does not answer. */
export async function signOut(): Promise<void> {
  const answer = await fetch(SIGN_OUT_PATH, {method: 'POST'});
  if (!answer.ok) throw new Error(`${SIGN_OUT_PATH}: ${answer.status}`);
  location.assign((await answer.json() as {to: string}).to);
}

async function ask(): Promise<void> {
  const answer = await fetch(SESSION_PATH);
  if (!answer.ok) throw new Error(`${SESSION_PATH}: ${answer.status}`);
  user.value = (await answer.json() as {user: User|null}).user;
}

let known = false;
const isRefused =
    computed(() => connection.value.state === 'unauthenticated');

// Asked at first, and again when calls begin to be refused: the session may be
// over. A page that is being left gets no answer.
effect(() => {
  if (!consoleSettings.value?.signIn || (known && !isRefused.value)) return;
  known = true;
  ask().catch(() => {});
});
