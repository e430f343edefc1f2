import type {JSX} from 'preact';
import {useEffect, useRef} from 'preact/hooks';

import {connection, signIn, token} from './data/client.js';
import {consoleSettings} from './data/console.js';
import {signInAddress, user} from './data/session.js';
import {leaveVehicle} from './data/vehicle.js';
import {IssuerSignIn} from './parts/sign_in.js';
import {route} from './route.js';
import {dark, switchTheme} from './theme.js';
import {CandidateView} from './views/candidate.js';
import {FleetView} from './views/fleet.js';
import {GroupView} from './views/group.js';
import {GroupsView} from './views/groups.js';
import {QueueView} from './views/queue.js';
import {ServerView} from './views/server.js';
import {VehicleView} from './views/vehicle.js';

function Banner() {
  const now = connection.value;
  if (now.state === 'unreachable') {
    return (
      <p class="banner" role="alert">
        No answer from revisitd since {now.since.toLocaleTimeString()}, trying
        again. What is shown is from before. <small>{now.message}</small>
      </p>
    );
  }
  if (now.state === 'unauthenticated') {
    return (
      <p class="banner" role="alert">
        revisitd asks who you are: {consoleSettings.value?.signIn ?
          <a href={signInAddress()}>sign in</a> : 'paste a token'}.
        {' '}<small>{now.message}</small>
      </p>
    );
  }
  return null;
}

function SignIn() {
  const details = useRef<HTMLDetailsElement>(null);
  const field = useRef<HTMLInputElement>(null);
  const submit = (event: Event) => {
    event.preventDefault();
    signIn(field.current!.value);
    field.current!.value = '';
    details.current!.open = false;
  };
  return (
    <details class="sign-in" ref={details}>
      <summary>{token.value || user.value ? 'Signed in' : 'Sign in'}</summary>
      <form onSubmit={submit}>
        <IssuerSignIn />
        <label>
          Bearer token
          <input ref={field} type="password" autocomplete="off"
                 spellcheck={false} name="token" />
        </label>
        <p>Kept for this tab, until it is closed.</p>
        <button type="submit">Use</button>
        {token.value &&
          <button type="button" onClick={() => signIn('')}>Sign out</button>}
      </form>
    </details>
  );
}

function Header() {
  const {view} = route.value;
  const current = (name: string) => view === name ? 'page' : undefined;
  return (
    <header class="top">
      <a class="skip" href="#main">To the content</a>
      <strong>revisit</strong>
      <nav aria-label="Views">
        <a href="/" aria-current={current('fleet')}>Fleet</a>
        <a href="/groups" aria-current={current('groups')}>Groups</a>
        <a href="/queue" aria-current={current('queue')}>Queue</a>
        <a href="/server" aria-current={current('server')}>Server</a>
      </nav>
      <button type="button" class="theme" onClick={switchTheme}>
        {dark.value ? 'Light' : 'Dark'}
      </button>
      <SignIn />
    </header>
  );
}

function View(): JSX.Element {
  const now = route.value;
  useEffect(() => {
    if (now.view !== 'vehicle' && now.view !== 'candidate') leaveVehicle();
  }, [now.view]);
  // A key for whom the view is about: another one begins anew.
  const who = token.value;
  switch (now.view) {
    case 'fleet': return <FleetView key={who} />;
    case 'groups': return <GroupsView key={who} />;
    case 'group': return <GroupView key={`${now.group} ${who}`} id={now.group} />;
    case 'queue': return <QueueView key={who} />;
    case 'server': return <ServerView key={who} name={now.server} />;
    case 'vehicle':
      return <VehicleView key={`${now.vehicle} ${who}`} id={now.vehicle} />;
    case 'candidate':
      return (
        <CandidateView key={`${now.vehicle} ${who}`} id={now.vehicle}
                       asked={now.asked} matched={now.matched} />
      );
    case 'none': return <h1>There is no such view</h1>;
  }
}

export function App() {
  return (
    <>
      <Header />
      <Banner />
      <main id="main" tabIndex={-1}><View /></main>
    </>
  );
}
