import {readFileSync} from 'node:fs';
import {webcrypto} from 'node:crypto';

import * as oidc from 'openid-client';

import type {OidcOptions} from './options.js';

// Node.js 18, which Debian 12 has, lacks the name.
globalThis.crypto ??= webcrypto as Crypto;

const DEADLINE_SECONDS = 10;

/** The tokens and the name that an issuer has given of somebody. */
export interface Tokens {
  /** The one that revisitd is shown. */
  bearer: string;
  /** Milliseconds since 1970 at which that one ends. */
  expires: number;
  /** Undefined where the issuer gives none. */
  refresh: string|undefined;
  id: string|undefined;
  subject: string;
  /** The name by which people know them. */
  name: string;
}

/** The secrets of a sign-in that has begun. */
export interface Attempt {
  state: string;
  nonce: string;
  verifier: string;
}

interface Claims {
  exp?: unknown;
}

/** Signing in did not work; the message is for people. */
export class SignInError extends Error {}

/** The claims in a JWT, unchecked, since revisitd checks them; undefined for
 * another kind of token. */
function claimsIn(token: string): Claims|undefined {
  try {
    const part = Buffer.from(token.split('.')[1], 'base64url').toString();
    return JSON.parse(part) as Claims;
  } catch {
    return undefined;
  }
}

/** The reason that an issuer, or the way to it, gives for a failure. */
export function reasonOf(error: unknown): string {
  if (error instanceof oidc.AuthorizationResponseError ||
      error instanceof oidc.ResponseBodyError) {
    return error.error_description ?
        `${error.error}: ${error.error_description}` : error.error;
  }
  const {message, cause} = error as Error;
  return cause instanceof Error ? `${message}: ${cause.message}` : message;
}

/** Whether the issuer itself takes a refresh token for one that has ended. */
export function hasEnded(error: unknown): boolean {
  return error instanceof oidc.ResponseBodyError &&
      error.error === 'invalid_grant';
}

/** An issuer of OpenID Connect, by whose code flow with PKCE people sign in. It
 * is found when it is first needed. */
export class Issuer {
  private readonly secret: string|undefined;
  private found: Promise<oidc.Configuration>|undefined;

  /** `callback` is the address to which it sends people back. Throws if the
   * file of the secret cannot be read. */
  constructor(private readonly options: OidcOptions,
              private readonly callback: URL) {
    const file = options.clientSecretFile;
    this.secret = file === undefined ? undefined :
                                       readFileSync(file, 'utf8').trim();
  }

  /** Where people go to sign in, and what to keep until they are back. */
  async begin(): Promise<[URL, Attempt]> {
    const configuration = await this.configuration();
    const attempt = {state: oidc.randomState(), nonce: oidc.randomNonce(),
                     verifier: oidc.randomPKCECodeVerifier()};
    const {scopes, resource} = this.options;
    const url = oidc.buildAuthorizationUrl(configuration, {
      redirect_uri: this.callback.href,
      scope: scopes,
      state: attempt.state,
      nonce: attempt.nonce,
      code_challenge: await oidc.calculatePKCECodeChallenge(attempt.verifier),
      code_challenge_method: 'S256',
      // OpenID Connect gives no refresh token without having people agree.
      ...scopes.split(' ').includes('offline_access') ? {prompt: 'consent'} :
                                                        {},
      ...resource === undefined ? {} : {resource},
    });
    return [url, attempt];
  }

  /** `query` is that of the address to which they came back. */
  async finish(query: string, attempt: Attempt): Promise<Tokens> {
    const here = new URL(this.callback);
    here.search = query;
    const answer = await oidc.authorizationCodeGrant(
        await this.configuration(), here, {
          pkceCodeVerifier: attempt.verifier,
          expectedState: attempt.state,
          expectedNonce: attempt.nonce,
          idTokenExpected: true,
        }, this.resource());
    return this.tokensOf(answer);
  }

  async refresh(before: Tokens): Promise<Tokens> {
    const answer = await oidc.refreshTokenGrant(
        await this.configuration(), before.refresh!, this.resource());
    return this.tokensOf(answer, before);
  }

  /** Gives the tokens back, and answers where people sign out of the issuer;
   * undefined where it has no such place. */
  async end({refresh, id}: Tokens): Promise<URL|undefined> {
    const configuration = await this.configuration();
    const metadata = configuration.serverMetadata();
    if (refresh !== undefined && metadata.revocation_endpoint) {
      await oidc.tokenRevocation(configuration, refresh,
                                 {token_type_hint: 'refresh_token'});
    }
    return metadata.end_session_endpoint ?
        oidc.buildEndSessionUrl(configuration, {
          post_logout_redirect_uri: new URL('/', this.callback).href,
          ...id === undefined ? {} : {id_token_hint: id},
        }) : undefined;
  }

  private resource(): Record<string, string> {
    const {resource} = this.options;
    return resource === undefined ? {} : {resource};
  }

  private configuration(): Promise<oidc.Configuration> {
    const {issuer, clientId} = this.options;
    this.found ??= oidc.discovery(
        issuer, clientId, undefined,
        this.secret === undefined ? oidc.None() :
                                    oidc.ClientSecretBasic(this.secret),
        {
          timeout: DEADLINE_SECONDS,
          // Only on the loopback is an issuer without TLS let in.
          execute: issuer.protocol === 'http:' ? [oidc.allowInsecureRequests] :
                                                 [],
        }).catch((error: unknown) => {
          this.found = undefined;
          throw error;
        });
    return this.found;
  }

  private tokensOf(
      answer: oidc.TokenEndpointResponse&oidc.TokenEndpointResponseHelpers,
      before?: Tokens): Tokens {
    const id = answer.id_token ?? before?.id;
    const bearer = this.options.token === 'id' ? id : answer.access_token;
    const exp = claimsIn(bearer ?? '')?.exp;
    if (bearer === undefined || typeof exp !== 'number') {
      throw new SignInError(
          `the issuer's ${this.options.token} token is no JWT that says when ` +
          'it ends, as revisitd needs it: see --oidc-resource, --oidc-token');
    }
    const claims = answer.claims();
    const subject = claims?.sub ?? before!.subject;
    const said = [claims?.name, claims?.preferred_username, claims?.email].find(
        (text): text is string => typeof text === 'string' && text !== '');
    return {bearer, expires: 1000 * exp, id, subject,
            refresh: answer.refresh_token ?? before?.refresh,
            name: said ?? before?.name ?? subject};
  }
}
