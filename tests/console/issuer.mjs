// An issuer of OpenID Connect by the package oidc-provider: who signs in, with
// any password, is whom they say they are.
import {generateKeyPairSync} from 'node:crypto';
import {createServer} from 'node:http';

import {Provider} from 'oidc-provider';

import {freePort} from './world.mjs';

const RESOURCE = 'https://revisit.example';
const AUDIENCE = 'revisit';

/** What `revisitd` and the console are told of it. */
export class OpenIdIssuer {
  /** Makes an issuer that listens, with a client for the console at `base`. */
  static async make(base) {
    const issuer = new OpenIdIssuer();
    issuer.base = base;
    issuer.port = await freePort();
    issuer.url = `http://127.0.0.1:${issuer.port}`;
    const {privateKey, publicKey} =
        generateKeyPairSync('rsa', {modulusLength: 2048});
    const about = {kid: 'one', use: 'sig', alg: 'RS256'};
    issuer.privateJwk = {...privateKey.export({format: 'jwk'}), ...about};
    issuer.publicJwk = {...publicKey.export({format: 'jwk'}), ...about};
    /** Seconds for which an access token is good. */
    issuer.lifetime = 600;
    /** Access tokens that were given. */
    issuer.given = 0;
    issuer.renewable = [];
    await issuer.start();
    return issuer;
  }

  /** Starts it, as it was when it was stopped. */
  async start() {
    const provider = new Provider(this.url, this.configuration());
    provider.on('access_token.issued', () => ++this.given);
    provider.on('refresh_token.saved', token => this.renewable.push(token));
    this.server = createServer(provider.callback());
    await new Promise(done => this.server.listen(this.port, '127.0.0.1', done));
  }

  /** Renews nobody's sign-in any more. */
  async forget() {
    for (const token of this.renewable.splice(0)) await token.destroy();
  }

  stop() {
    this.server.closeAllConnections();
    return new Promise(done => this.server.close(done));
  }

  configuration() {
    return {
      clients: [{
        client_id: 'console',
        token_endpoint_auth_method: 'none',
        redirect_uris: [`${this.base}/signed-in`],
        post_logout_redirect_uris: [`${this.base}/`],
        grant_types: ['authorization_code', 'refresh_token'],
        response_types: ['code'],
      }],
      jwks: {keys: [this.privateJwk]},
      cookies: {keys: ['a key of the test']},
      scopes: ['openid', 'offline_access', 'profile'],
      claims: {openid: ['sub'], profile: ['name']},
      conformIdTokenClaims: false,
      findAccount: (_, id) => ({
        accountId: id, claims: () => ({sub: id, name: `${id} & <b>co</b>`}),
      }),
      pkce: {required: () => true, methods: ['S256']},
      ttl: {AccessToken: () => this.lifetime, Grant: 3600, IdToken: 3600,
            Interaction: 600, RefreshToken: 3600, Session: 3600},
      features: {
        devInteractions: {enabled: true},
        revocation: {enabled: true},
        rpInitiatedLogout: {enabled: true},
        resourceIndicators: {
          enabled: true,
          useGrantedResource: () => true,
          getResourceServerInfo: () => ({
            scope: '', audience: AUDIENCE, accessTokenFormat: 'jwt',
            accessTokenTTL: this.lifetime, jwt: {sign: {alg: 'RS256'}},
          }),
        },
      },
    };
  }

  /** Flags of a revisitd that believes it; `write` makes a file of a content and
   * returns its path. */
  serverFlags(write, policy) {
    return ['--token-keys', write({keys: [this.publicJwk]}),
            '--token-issuer', this.url, '--token-audience', AUDIENCE,
            '--policy', write(policy)];
  }

  /** Flags of a console whose people sign in here. */
  consoleFlags() {
    return ['--oidc-issuer', this.url, '--oidc-client-id', 'console',
            '--oidc-resource', RESOURCE];
  }
}
