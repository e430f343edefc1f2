import {collectDefaultMetrics, Counter, Gauge, Histogram, Registry} from
    'prom-client';

/** The purposes of requests. */
export type RequestKind =
    'page'|'call'|'metrics'|'base_map'|'sign_in'|'refused';
export type SignInResult = 'ok'|'failed';

const SECONDS = [0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1,
                 2.5, 5, 10, 30];

/** Numbers about the console for Prometheus. None names a vehicle or a caller,
 * so that there are not more of them with more use. */
export class Telemetry {
  private readonly registry = new Registry();
  private readonly requests = new Counter({
    name: 'revisit_console_requests_total',
    help: 'Requests that were answered, by kind and status of HTTP',
    labelNames: ['kind', 'status'], registers: [this.registry],
  });
  private readonly requestSeconds = new Histogram({
    name: 'revisit_console_request_seconds',
    help: 'From the headers of a request to the end of its answer',
    labelNames: ['kind'], buckets: SECONDS, registers: [this.registry],
  });
  private readonly calls = new Counter({
    name: 'revisit_console_calls_total',
    help: 'Calls that were passed on to revisitd, by method and code',
    labelNames: ['method', 'code'], registers: [this.registry],
  });
  private readonly callSeconds = new Histogram({
    name: 'revisit_console_call_seconds',
    help: 'From passing a call on to the end of the answer of revisitd',
    labelNames: ['method'], buckets: SECONDS, registers: [this.registry],
  });
  private readonly open = new Gauge({
    name: 'revisit_console_streams_open',
    help: 'Streams from revisitd that are passed on',
    registers: [this.registry],
  });
  private readonly signIns = new Counter({
    name: 'revisit_console_sign_ins_total',
    help: 'Sign-ins at the issuer, by result', labelNames: ['result'],
    registers: [this.registry],
  });
  private readonly up = new Gauge({
    name: 'revisit_console_server_up',
    help: 'Whether a revisitd answers, by its address', labelNames: ['server'],
    registers: [this.registry],
  });

  constructor() {
    collectDefaultMetrics({register: this.registry});
    for (const result of ['ok', 'failed']) this.signIns.inc({result}, 0);
  }

  answered(kind: RequestKind, status: number, seconds: number): void {
    this.requests.inc({kind, status});
    this.requestSeconds.observe({kind}, seconds);
  }

  called(method: string, code: string, seconds: number): void {
    this.calls.inc({method, code});
    this.callSeconds.observe({method}, seconds);
  }

  streamBegan(): void {
    this.open.inc();
  }

  streamEnded(): void {
    this.open.dec();
  }

  signedIn(result: SignInResult): void {
    this.signIns.inc({result});
  }

  serverIs(server: string, up: boolean): void {
    this.up.set({server}, up ? 1 : 0);
  }

  /** `count` is asked at each reading. */
  observeSessions(count: () => number): void {
    new Gauge({
      name: 'revisit_console_sessions',
      help: 'People who are signed in at the issuer',
      registers: [this.registry],
      collect() {
        this.set(count());
      },
    });
  }

  get contentType(): string {
    return this.registry.contentType;
  }

  /** All of them, as Prometheus reads them. */
  text(): Promise<string> {
    return this.registry.metrics();
  }
}
