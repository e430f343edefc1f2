import {randomBytes} from 'node:crypto';

import {hasEnded, type Issuer, type Tokens} from './issuer.js';

/** However long the issuer would let it go on. */
const LONGEST_MILLISECONDS = 12 * 3600 * 1000;
/** A token that ends so soon is not shown to revisitd any more. */
const REFRESH_MILLISECONDS = 30_000;
const MOST_SESSIONS = 10_000;

interface Session {
  tokens: Tokens;
  /** Milliseconds since 1970. */
  ends: number;
  /** The refresh that is on, which all who need it wait for. */
  refreshing: Promise<void>|undefined;
}

/** Who is signed in. It is kept in memory, so that tokens lie nowhere, and ends
 * with the console. */
export class Sessions {
  /** By the secret in the cookie; the eldest first. */
  private readonly sessions = new Map<string, Session>();

  constructor(private readonly issuer: Issuer) {}

  get size(): number {
    return this.sessions.size;
  }

  /** Returns the secret by which a session is found again. */
  add(tokens: Tokens): string {
    const secret = randomBytes(32).toString('base64url');
    this.sessions.set(secret, {tokens, ends: Date.now() + LONGEST_MILLISECONDS,
                               refreshing: undefined});
    if (this.sessions.size > MOST_SESSIONS) {
      this.sessions.delete(this.sessions.keys().next().value!);
    }
    return secret;
  }

  remove(secret: string): Tokens|undefined {
    const session = this.sessions.get(secret);
    this.sessions.delete(secret);
    return session?.tokens;
  }

  /** Tokens that are still good; undefined if the session has ended. Throws if
   * they are not, and the issuer cannot be asked for the next ones. */
  async tokensOf(secret: string): Promise<Tokens|undefined> {
    const session = this.sessions.get(secret);
    if (!session) return undefined;
    const now = Date.now();
    const {expires, refresh} = session.tokens;
    const isOver = now >= expires;
    if (now >= session.ends || (isOver && refresh === undefined)) {
      this.sessions.delete(secret);
    } else if (refresh !== undefined && now >= expires - REFRESH_MILLISECONDS) {
      const renewed = this.renew(secret, session);
      // While the tokens are good, nobody waits for the next ones.
      if (isOver) await renewed;
      renewed.catch(() => undefined);
    }
    return this.sessions.get(secret)?.tokens;
  }

  private renew(secret: string, session: Session): Promise<void> {
    session.refreshing ??= this.issuer.refresh(session.tokens).then(
        tokens => {
          session.tokens = tokens;
        },
        (error: unknown) => {
          if (!hasEnded(error)) throw error;
          this.sessions.delete(secret);
        }).finally(() => {
          session.refreshing = undefined;
        });
    return session.refreshing;
  }
}
