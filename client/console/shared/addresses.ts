// The addresses of the console's views. The page shows the view of its address,
// and the server answers with the page at the address of every view.

export type Route =
    {view: 'fleet'}|{view: 'groups'}|{view: 'group', group: string}|
    {view: 'queue'}|{view: 'server', server?: string}|
    {view: 'vehicle', vehicle: string}|
    {view: 'candidate', vehicle: string, asked: number, matched: number}|
    {view: 'none'};

/** The text itself where it is no encoding of one. */
function decoded(text: string): string {
  try {
    return decodeURIComponent(text);
  } catch {
    return text;
  }
}

/** The view at a path; 'none' where there is none. */
export function routeOf(path: string): Route {
  if (path === '/') return {view: 'fleet'};
  if (path === '/groups') return {view: 'groups'};
  const group = /^\/groups\/([a-z0-9-]+)$/.exec(path);
  if (group) return {view: 'group', group: group[1]};
  if (path === '/queue') return {view: 'queue'};
  if (path === '/server') return {view: 'server'};
  const server = /^\/server\/([\w.:%-]+)$/.exec(path);
  if (server) return {view: 'server', server: decoded(server[1])};
  const found =
      /^\/vehicles\/([a-z0-9-]+)(?:\/candidates\/(\d+)-(\d+))?$/.exec(path);
  if (!found) return {view: 'none'};
  const [, vehicle, asked, matched] = found;
  return asked === undefined ?
      {view: 'vehicle', vehicle} :
      {view: 'candidate', vehicle, asked: Number(asked),
       matched: Number(matched)};
}

// Addresses of signing in, which are no views.

/** Where signing in begins; the parameter `to` is the view to come back to. */
export const SIGN_IN_PATH = '/sign-in';
/** Where the issuer sends people back to. */
export const CALLBACK_PATH = '/signed-in';
/** Ends the sign-in, by POST. */
export const SIGN_OUT_PATH = '/sign-out';
/** Tells the page who is signed in. */
export const SESSION_PATH = '/session.json';
