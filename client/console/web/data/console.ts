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

async function ask(): Promise<void> {
  const answer = await fetch('/console.json');
  if (!answer.ok) throw new Error(`/console.json: ${answer.status}`);
  consoleSettings.value = await answer.json() as ConsoleSettings;
}

ask().catch((error: unknown) => console.error(error));
