import type {ComponentChildren} from 'preact';

import {useKeys} from './keys.js';

/** Something that people do by a button or by its key. */
export interface KeyedButton {
  /** The name that KeyboardEvent.key has for it. */
  key: string;
  text: string;
  /** Undefined where it cannot be done now. */
  act: (() => void)|undefined;
  /** A class of the button, for its looks. */
  looks?: 'confirm'|'reject';
}

/** Gives what can be done only where it can. */
export function doIf(may: boolean, act: () => void): (() => void)|undefined {
  return may ? act : undefined;
}

/** A row of buttons, and their keys from when it is there. The children stand at
 * its end. */
export function KeyedButtons({buttons, children}:
    {buttons: readonly KeyedButton[], children?: ComponentChildren}) {
  useKeys(Object.fromEntries(
      buttons.map(({key, act}) => [key, () => act?.()])));
  return (
    <div class="buttons">
      {buttons.map(({key, text, act, looks}) => (
        <button key={key} type="button" class={looks} disabled={!act}
                onClick={act}>
          {text} <kbd>{key}</kbd>
        </button>
      ))}
      {children}
    </div>
  );
}
