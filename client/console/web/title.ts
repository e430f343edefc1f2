// The browser's tab is named after the view, so that tabs can be told apart.
import {useEffect} from 'preact/hooks';

/** Calls the tab so, the narrowest first. */
export function useTitle(...parts: string[]): void {
  const title = [...parts, 'revisit'].join(' · ');
  useEffect(() => {
    document.title = title;
  }, [title]);
}
