import {effect, signal} from '@preact/signals';

const KEY = 'revisit-theme';
const system = matchMedia('(prefers-color-scheme: dark)');
const chosen = localStorage.getItem(KEY);

/** Whether the page is dark: as the system is, until somebody chooses. */
export const dark = signal(chosen ? chosen === 'dark' : system.matches);

system.addEventListener('change', () => {
  if (!localStorage.getItem(KEY)) dark.value = system.matches;
});

effect(() => {
  document.documentElement.dataset.theme = dark.value ? 'dark' : 'light';
});

export function switchTheme(): void {
  dark.value = !dark.value;
  localStorage.setItem(KEY, dark.value ? 'dark' : 'light');
}
