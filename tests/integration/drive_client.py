"""A client that remembers: what it sent, and what was acknowledged. It is the
oracle of every test in which a server comes to harm."""

import random
import threading

import grpc

from stubs import api
from wire import as_bytes, get, list_poses, pose

VEHICLE = "vehicles/survivor"


def create(stub, name=VEHICLE, **settings):
    return stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=name.split("/")[1],
        vehicle=api.Vehicle(settings=api.VehicleSettings(**settings)))).vehicle


class Drive:
    """A drive without end whose poses use every bit of their numbers, and are
    the same whenever they are asked for."""

    def __init__(self, seed):
        self._seed = seed
        self._poses = []

    def __getitem__(self, index):
        while len(self._poses) < index.stop:
            self._poses.append(self._make(len(self._poses) + 1))
        return self._poses[index]

    def _make(self, sequence):
        rng = random.Random(self._seed * 1000003 + sequence)
        made = pose(sequence, x=sequence * 0.7 + rng.random(),
                    y=rng.gauss(0.0, 1.0), heading=rng.uniform(-9.0, 9.0),
                    covariance=[rng.uniform(1, 2), rng.uniform(-.1, .1), -0.0,
                                rng.uniform(1, 2), 5e-324, rng.random() + .1])
        if sequence % 3 == 0:
            made.stamp.seconds = rng.randrange(2**32)
            made.stamp.nanos = rng.randrange(10**9)
        if sequence % 5 == 0:
            made.quaternion.w, made.quaternion.z = 0.8, -0.6
            made.local.z_meters = rng.random()
        if sequence % 7 == 0:
            made.covariance.form = api.COVARIANCE_FORM_SPATIAL_10
            made.covariance.values[:] = [2, .1, 0, 0, 3, 0, 0, 4, 0,
                                         rng.random() + .1]
        return made


def cancel_if_forgotten(call, server, ended):
    """Cancels a call whose server has died, should gRPC for Python not end it:
    once in some thousand kills on a busy machine it hears nothing of them."""
    while not ended.wait(0.05):
        if not server.is_running():
            if not ended.wait(10):
                print("gRPC did not notice the end of the server")
                call.cancel()
            return


class Client:
    """Keeps what it sent and the highest sequence that was acknowledged."""

    # Batches that may wait for their ack.
    WINDOW = 8

    def __init__(self, drive, rng):
        self.drive, self.rng = drive, rng
        self.acked = 0
        self.sent = 0
        self.verified = 0

    def stream(self, server, until=None, kill_after=None):
        """Streams until the sequence is acknowledged, or the server is gone;
        answers whether it got that far. Kills the server so many seconds after
        the stream was opened, if it is to."""
        window = threading.Semaphore(self.WINDOW)
        stopped = threading.Event()
        opened = threading.Event()
        start = []

        def requests():
            yield api.StreamPosesRequest(open=api.StreamPosesOpen(
                vehicle=VEHICLE, acked_sequence=self.acked,
                send_candidates=True))
            opened.wait()
            next_sequence = start[0] + 1
            while not stopped.is_set() and (until is None
                                            or next_sequence <= until):
                window.acquire()
                count = self.rng.randint(1, 16)
                if until is not None:
                    count = min(count, until - next_sequence + 1)
                poses = self.drive[next_sequence - 1:next_sequence + count - 1]
                self.sent = max(self.sent, next_sequence + count - 1)
                next_sequence += count
                yield api.StreamPosesRequest(batch=api.PoseBatch(poses=poses))

        call = server.stub().StreamPoses(requests(), timeout=60)
        ended = threading.Event()
        watch = threading.Thread(target=cancel_if_forgotten,
                                 args=(call, server, ended), daemon=True)
        watch.start()
        try:
            for response in call:
                kind = response.WhichOneof("message")
                if kind == "opened":
                    durable = response.opened.durable_sequence
                    assert self.acked <= durable <= self.sent
                    start.append(durable)
                    opened.set()
                    if kill_after is not None:
                        threading.Timer(kill_after,
                                        server.process.kill).start()
                elif kind == "ack":
                    self.acked = max(self.acked, response.ack.durable_sequence)
                    window.release()
        except grpc.RpcError as error:
            if error.code() not in (grpc.StatusCode.UNAVAILABLE,
                                    grpc.StatusCode.CANCELLED):
                raise
            return False
        finally:
            ended.set()
            watch.join()
            # Whatever happened, the sender's thread must come to its end.
            stopped.set()
            start.append(0)
            opened.set()
            window.release()
        return True

    def verify(self, stub, whole=False):
        """Everything acknowledged is there, bit for bit, and nothing but a
        prefix of what was sent."""
        durable = get(stub, VEHICLE).durable_sequence
        assert self.acked <= durable <= self.sent
        first = 1 if whole else self.verified + 1
        stored = list_poses(stub, VEHICLE, first_sequence=first)
        assert len(stored) == durable - first + 1
        assert as_bytes(stored) == as_bytes(self.drive[first - 1:durable])
        self.verified = durable
        return durable
