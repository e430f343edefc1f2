import {useLayoutEffect, useRef} from 'preact/hooks';

/** The keys of the view, from when it is there: an effect that waits for a
 * frame would lose the key of somebody who presses it as soon as the table is
 * seen. */
export function useKeys(keys: Record<string, () => void>): void {
  const latest = useRef(keys);
  latest.current = keys;
  useLayoutEffect(() => {
    const onKey = (event: KeyboardEvent) => {
      const target = event.target as HTMLElement;
      if (event.key === 'Escape') target.blur();
      if (event.ctrlKey || event.metaKey || event.altKey || event.repeat ||
          target.closest('input:not([type=checkbox]), textarea, select') ||
          // Enter is the key of whatever has the focus, if that has one.
          (event.key === 'Enter' &&
           target.closest('a, button, summary, input'))) {
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
}
