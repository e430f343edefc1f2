import {createCipheriv, createDecipheriv, randomBytes} from 'node:crypto';
import type {IncomingMessage} from 'node:http';

const NONCE_BYTES = 12;
const TAG_BYTES = 16;

/** The cookies of one console: of its host alone, sent by its own pages and by
 * links to them, and out of reach of scripts. */
export class Cookies {
  private readonly key = randomBytes(32);

  /** `secure` for a console that browsers reach by TLS. */
  constructor(private readonly secure: boolean) {}

  /** Undefined if the browser did not send it. */
  read(request: IncomingMessage, name: string): string|undefined {
    const prefix = `${this.fullName(name)}=`;
    for (const part of (request.headers.cookie ?? '').split(';')) {
      const cookie = part.trim();
      if (cookie.startsWith(prefix)) return cookie.slice(prefix.length);
    }
    return undefined;
  }

  /** The value of Set-Cookie; without `seconds` it lasts as long as the browser
   * runs. */
  made(name: string, value: string, seconds?: number): string {
    return [
      `${this.fullName(name)}=${value}`, 'Path=/', 'HttpOnly', 'SameSite=Lax',
      ...this.secure ? ['Secure'] : [],
      ...seconds === undefined ? [] : [`Max-Age=${seconds}`],
    ].join('; ');
  }

  /** The value of Set-Cookie that removes one. */
  removed(name: string): string {
    return this.made(name, '', 0);
  }

  /** Makes a value of a text that the browser can neither read nor change, and
   * that no other run of the console takes. */
  seal(text: string): string {
    const nonce = randomBytes(NONCE_BYTES);
    const cipher = createCipheriv('aes-256-gcm', this.key, nonce);
    const sealed = [cipher.update(text, 'utf8'), cipher.final()];
    return Buffer.concat([nonce, cipher.getAuthTag(), ...sealed])
        .toString('base64url');
  }

  /** Undefined unless `seal` made it. */
  unseal(value: string): string|undefined {
    const bytes = Buffer.from(value, 'base64url');
    const from = NONCE_BYTES + TAG_BYTES;
    if (bytes.length < from) return undefined;
    const decipher = createDecipheriv('aes-256-gcm', this.key,
                                      bytes.subarray(0, NONCE_BYTES),
                                      {authTagLength: TAG_BYTES});
    decipher.setAuthTag(bytes.subarray(NONCE_BYTES, from));
    try {
      return decipher.update(bytes.subarray(from), undefined, 'utf8') +
          decipher.final('utf8');
    } catch {
      return undefined;
    }
  }

  /** The prefix has browsers take it from this host by TLS only. */
  private fullName(name: string): string {
    return (this.secure ? '__Host-' : '') + name;
  }
}
