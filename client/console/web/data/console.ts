// The page asks the console itself which of the optional parts it has.
import {signal} from '@preact/signals';

import type {LinkTemplate} from '../../shared/links.js';

export interface ConsoleSettings {
  /** Whether it knows where revisitd tells its metrics. */
  metrics: boolean;
  /** Whether it has a base map. */
  baseMap: boolean;
  /** Links from a pair of poses to other programs. */
  links: LinkTemplate[];
  /** Whether people can sign in at an issuer. */
  signIn: boolean;
}

/** Undefined until the console has answered. */
export const consoleSettings = signal<ConsoleSettings|undefined>(undefined);

const RETRY_MILLISECONDS = 1000;

async function ask(): Promise<ConsoleSettings> {
  const answer = await fetch('/console.json');
  if (!answer.ok) throw new Error(`/console.json: ${answer.status}`);
  return await answer.json() as ConsoleSettings;
}

// Asked until there is an answer, since without it the page lacks parts. A page
// that is being left gets none, and that is no error.
async function learn(): Promise<void> {
  while (!consoleSettings.value) {
    try {
      consoleSettings.value = await ask();
    } catch {
      await new Promise(done => setTimeout(done, RETRY_MILLISECONDS));
    }
  }
}

void learn();
