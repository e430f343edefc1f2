import {useLayoutEffect, useRef} from 'preact/hooks';

/** The keys of the view, from when it is there: an effect that waits for a
 * frame would lose the key of somebody who presses it as soon as the table is
 * seen. `onAny` is told of every key that is pressed, also of those that do
 * nothing here, but not of what is typed into a field. */
export function useKeys(keys: Record<string, () => void>,
                        onAny?: (key: string) => void): void {
  const latest = useRef({keys, onAny});
  latest.current = {keys, onAny};
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
      latest.current.onAny?.(event.key);
      const act = latest.current.keys[event.key];
      if (!act) return;
      event.preventDefault();
      act();
    };
    addEventListener('keydown', onKey);
    return () => removeEventListener('keydown', onKey);
  }, []);
}
