"""A vehicle that streams its poses, as the client library does."""

import math

import server as servers


class Backoff:
    """client/revisit/backoff.cc."""

    def __init__(self, parameters, random):
        self._p = parameters
        self._random = random
        self._wait = parameters.backoff_initial_s

    def reset(self):
        self._wait = self._p.backoff_initial_s

    def next(self, asked, retry_info_rules):
        longest = min(self._wait, self._p.backoff_max_s)
        shortest = (1.0 - self._p.backoff_jitter) * longest
        own = self._random.uniform(shortest, longest)
        if asked is not None and retry_info_rules:
            return asked
        self._wait = min(self._wait * self._p.backoff_multiplier,
                         self._p.backoff_max_s)
        if asked is None or asked <= own:
            return own
        return asked + own - shortest


class Vehicle:
    """One stream of poses through one Envoy, one message on its way at a time."""

    def __init__(self, kernel, parameters, policy, envoy, key, pose_hz, message_s,
                 max_age, watch):
        self._kernel = kernel
        self._p = parameters
        self._policy = policy
        self._envoy = envoy
        self.key = key
        self._pose_hz = pose_hz
        self._message_s = message_s
        self._max_age = max_age
        self._watch = watch
        self._backoff = Backoff(parameters, kernel.random)
        self._born = kernel.now - kernel.random.random() / pose_hz
        self._server = None
        self._opened = 0.0
        self._sending = False
        self._attempt = 0
        self.acked = 0
        self.last_ack = kernel.now
        self.longest_gap = 0.0
        self.attempts = 0
        # Losses that the server's answer showed: acked before, not there now.
        self.told_lost = 0
        kernel.after(kernel.random.random() * message_s, self._tick)

    @property
    def produced(self):
        return int((self._kernel.now - self._born) * self._pose_hz)

    def adopt(self, server, durable):
        """Begins with an open stream."""
        self._server = server
        self.acked = durable
        self._born -= durable / self._pose_hz
        # Streams were opened at any time before.
        self._opened = self._kernel.now - (
            self._kernel.random.random() * self._max_age
            if math.isfinite(self._max_age) else 0.0)

    def through(self, envoy):
        """Calls go through this Envoy from now on."""
        self._envoy = envoy

    def open(self, owner=None):
        self._attempt += 1
        self.attempts += 1
        attempt = self._attempt
        server = self._envoy.route(self.key, owner)
        if server is None:
            self._again(attempt, servers.Refusal("UNAVAILABLE"))
            return
        hop = 2 * self._p.hop_s
        self._kernel.after(
            hop, server.open, self.key, self,
            lambda answer: self._kernel.after(hop, self._answered, attempt, server,
                                              answer))
        self._kernel.after(self._p.answer_timeout_s, self._timed_out, attempt)

    def _timed_out(self, attempt):
        if attempt == self._attempt and self._server is None:
            self._again(attempt, servers.Refusal("TIMEOUT"))

    def _answered(self, attempt, server, answer):
        if attempt != self._attempt:
            return
        if isinstance(answer, servers.Refusal):
            self._again(attempt, answer)
            return
        self._attempt += 1
        if answer < self.acked:
            self.told_lost += self.acked - answer
            self._watch.regressed(self.key)
            # The vehicle's operator accepts the loss; the poses come again.
        self.acked = answer
        self._server = server
        self._opened = self._kernel.now
        self._sending = False
        self._send()

    def _again(self, attempt, refusal):
        if attempt != self._attempt:
            return
        self._attempt += 1
        self._watch.refused(refusal.reason)
        wait = self._backoff.next(refusal.retry, self._policy.retry_info_rules)
        owner = refusal.owner if self._policy.owner_header else None
        self._kernel.after(wait, self._open_if, self._attempt, owner)

    def _open_if(self, attempt, owner):
        if attempt == self._attempt:
            self.open(owner)

    def _tick(self):
        self._kernel.after(self._message_s, self._tick)
        if self._server is None or self._sending:
            return
        if self._kernel.now - self._opened > self._max_age:
            self._server = None
            self._again(self._attempt, servers.Refusal(
                "STREAM_AGE", self._kernel.random.uniform(0.0, 1.0)))
            return
        self._send()

    def _send(self):
        count = self.produced - self.acked
        if count <= 0:
            self.last_ack = self._kernel.now
            self._watch.moving(self)
            return
        self._sending = True
        self._kernel.after(2 * self._p.hop_s, self._server.append, self.key, self,
                           self.acked + 1, count)

    def on_ack(self, server, durable):
        self._kernel.after(2 * self._p.hop_s, self._acked, server, durable)

    def _acked(self, server, durable):
        if server is not self._server:
            return
        self._sending = False
        self.acked = max(self.acked, durable)
        self._backoff.reset()
        gap = self._kernel.now - self.last_ack
        self.longest_gap = max(self.longest_gap, gap)
        self.last_ack = self._kernel.now
        self._watch.acknowledged(self.key, self.acked)
        self._watch.moving(self)

    def on_end(self, server, refusal):
        self._kernel.after(2 * self._p.hop_s, self._ended, server, refusal)

    def _ended(self, server, refusal):
        if server is self._server:
            self._server = None
            self._sending = False
            self._again(self._attempt, refusal)

    def cut(self, server):
        """The connection to this server breaks."""
        self._ended(server, servers.Refusal("CUT"))


class UnaryCaller:
    """Somebody who calls a vehicle's owner every now and then, a verifier for
    instance. A call is tried again a few times, then it has failed."""

    def __init__(self, kernel, parameters, policy, envoy, key, every, retries, watch):
        self._kernel = kernel
        self._p = parameters
        self._policy = policy
        self._envoy = envoy
        self._key = key
        self._every = every
        self._retries = retries
        self._watch = watch
        self.answered = 0
        self.failed = 0
        kernel.after(kernel.random.random() * every, self._call)

    def _call(self):
        self._try(self._retries, Backoff(self._p, self._kernel.random), None)

    def _try(self, retries, backoff, owner):
        server = self._envoy.route(self._key, owner)
        hop = 2 * self._p.hop_s
        if server is None:
            self._answer(retries, backoff, servers.Refusal("UNAVAILABLE"))
            return
        self._kernel.after(
            hop, server.open, self._key, None,
            lambda answer: self._kernel.after(
                hop, self._answer, retries, backoff, answer))

    def _answer(self, retries, backoff, answer):
        if not isinstance(answer, servers.Refusal):
            self.answered += 1
        elif retries == 0:
            self.failed += 1
        else:
            self._watch.refused(answer.reason)
            wait = backoff.next(answer.retry, self._policy.retry_info_rules)
            owner = answer.owner if self._policy.owner_header else None
            self._kernel.after(wait, self._try, retries - 1, backoff, owner)
            return
        self._kernel.after(self._every, self._call)
