// The address of the page says what it shows, so that every view has a link. The
// addresses are in ../shared/addresses.ts, for the server answers at them too.
import {computed, signal} from '@preact/signals';

import {routeOf} from '../shared/addresses.js';

const address = signal(location.pathname + location.search);

export const route = computed(() => routeOf(address.value.split('?')[0]));

/** The part of the address behind its question mark. */
export const query =
    computed(() => new URLSearchParams(address.value.split('?')[1] ?? ''));

export function go(to: string): void {
  history.pushState(null, '', to);
  address.value = to;
  window.scrollTo(0, 0);
}

/** Changes one part of the address without a new entry in the history;
 * undefined removes it. */
export function setQuery(name: string, value: string|undefined): void {
  const changed = new URLSearchParams(query.value);
  if (value === undefined) {
    changed.delete(name);
  } else {
    changed.set(name, value);
  }
  const text = changed.toString();
  const to = location.pathname + (text ? `?${text}` : '');
  history.replaceState(null, '', to);
  address.value = to;
}

addEventListener('popstate', () => {
  address.value = location.pathname + location.search;
});

// Links within the console change the view, not the page.
document.addEventListener('click', event => {
  const link = (event.target as Element).closest?.('a');
  if (!link || event.defaultPrevented || event.button !== 0 || event.ctrlKey ||
      event.metaKey || event.shiftKey || link.origin !== location.origin ||
      link.hasAttribute('download') || routeOf(link.pathname).view === 'none' ||
      link.getAttribute('href')!.startsWith('#')) {
    return;
  }
  event.preventDefault();
  go(link.pathname + link.search);
});
