import {useState} from 'preact/hooks';

import {consoleSettings} from '../data/console.js';
import {signInAddress, signOut, user} from '../data/session.js';

/** Signing in and out at the issuer; nothing where the console knows none. */
export function IssuerSignIn() {
  const [problem, setProblem] = useState('');
  if (!consoleSettings.value?.signIn) return null;
  if (!user.value) {
    return <p><a href={signInAddress()}>Sign in at the issuer</a></p>;
  }
  const leave = () => {
    signOut().catch((error: Error) => setProblem(error.message));
  };
  return (
    <>
      <p>Signed in as {user.value.name}.</p>
      <p><button type="button" onClick={leave}>Sign out there</button></p>
      {problem && <p class="error">{problem}</p>}
    </>
  );
}
