import { ClientError, Status } from "nice-grpc";
import {
  BadRequest,
  ErrorInfo,
  RetryInfo,
  RichClientError,
} from "nice-grpc-error-details";

const ATTEMPTS = 10;

/**
 * What an error of revisit carries. Each may be missing, and all are where the error
 * comes from the transport.
 */
export interface Details {
  info?: ErrorInfo;
  badRequest?: BadRequest;
  retry?: RetryInfo;
}

export function detailsOf(error: ClientError): Details {
  const found: Details = {};
  for (const detail of error instanceof RichClientError ? error.extra : []) {
    switch (detail.$type) {
      case ErrorInfo.$type:
        found.info = detail as ErrorInfo;
        break;
      case BadRequest.$type:
        found.badRequest = detail as BadRequest;
        break;
      case RetryInfo.$type:
        found.retry = detail as RetryInfo;
        break;
    }
  }
  return found;
}

/**
 * Milliseconds to wait before the stream is opened again, or undefined if that is of
 * no use.
 */
export function waitBeforeRetry(error: ClientError, attempt: number): number | undefined {
  const { info, retry } = detailsOf(error);
  if (attempt > ATTEMPTS) {
    return undefined;
  }
  if (retry?.retryDelay !== undefined) {
    return Number(retry.retryDelay.seconds) * 1e3 + retry.retryDelay.nanos / 1e6;
  }
  const lost =
    error.code === Status.UNAVAILABLE ||
    (error.code === Status.INTERNAL && info === undefined);
  const longest = Math.min(2000, 100 * 2 ** attempt);
  return lost ? longest * (0.5 + 0.5 * Math.random()) : undefined;
}
