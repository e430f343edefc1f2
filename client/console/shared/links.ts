// Templates of links from a pair of poses to other programs: a viewer of
// recordings, or a server of camera pictures.

/** The values that a template may name in braces. */
export const LINK_VALUES = [
  'vehicle', 'pose_a', 'pose_b', 'time_a', 'time_b', 'unix_a', 'unix_b',
] as const;
export type LinkValues = Record<typeof LINK_VALUES[number], string|undefined>;

export interface LinkTemplate {
  name: string;
  /** An address with names of LINK_VALUES in braces. */
  template: string;
}

const NAMES = /\{([^{}]*)\}/g;

/** Why a template cannot be used; undefined if it can. */
export function problemOf(template: string): string|undefined {
  for (const [, name] of template.matchAll(NAMES)) {
    if (!(LINK_VALUES as readonly string[]).includes(name)) {
      return `{${name}} is none of ${
          LINK_VALUES.map(known => `{${known}}`).join(' ')}`;
    }
  }
  const [, beforePath] = /^([a-z]+:\/\/[^/?#]*)/i.exec(template) ?? [];
  if (beforePath === undefined || /[{}]/.test(beforePath)) {
    return 'it has to begin with http://HOST or https://HOST';
  }
  try {
    const {protocol, username, password} = new URL(beforePath);
    if (!/^https?:$/.test(protocol)) return 'it is neither http nor https';
    if (username || password) return 'it holds a name or a password';
  } catch {
    return 'it is no address';
  }
  return undefined;
}

/** The address for these values; undefined if it names one that is not
 * known. */
export function linkFor({template}: LinkTemplate, values: LinkValues):
    string|undefined {
  let isWhole = true;
  const address = template.replaceAll(NAMES, (_, name: string) => {
    const value = values[name as keyof LinkValues];
    isWhole &&= value !== undefined;
    return encodeURIComponent(value ?? '');
  });
  return isWhole && problemOf(template) === undefined ? address : undefined;
}
