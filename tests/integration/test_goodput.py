"""What a server still does when it is asked for more than it can do. Runs alone:
what else the machine does would count against it."""

import threading
import time

import grpc
import pytest

from revisit_server import Server
from test_limits import SLOW, create, fill, search
from wire import laps


@pytest.mark.release_build
def test_goodput_at_five_times_the_load_stays_near_the_peak(tmp_path):
    """Callers come at their own pace, whether answered or not, and wait no
    longer than a second. What is answered in time counts."""
    with Server(tmp_path / "store", "--search-threads=1",
                "--log-level=error") as server:
        stub = server.stub()
        names = [f"car-{i}" for i in range(8)]
        for name in names:
            # A search of these takes far longer than a call of this program.
            fill(stub, create(stub, name, sequence_length_meters=300,
                              node_spacing_meters=0.5),
                 laps(4000, spacing=2.0))
        requests = [search(f"vehicles/{name}", **SLOW) for name in names]

        def measure_peak(seconds):
            start = time.monotonic()
            done, end = [0] * 8, start + seconds

            def ask(i):
                own = server.stub()
                while time.monotonic() < end:
                    own.FindCandidates(requests[i])
                    done[i] += 1

            threads = [threading.Thread(target=ask, args=(i,))
                       for i in range(8)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            # Up to the last answer.
            return sum(done) / (time.monotonic() - start)

        def measure_goodput(rate, seconds):
            futures, start = [], time.monotonic()
            sent = 0
            while time.monotonic() < start + seconds:
                due = int((time.monotonic() - start) * rate)
                while sent < due:
                    futures.append(stub.FindCandidates.future(
                        requests[sent % 8], timeout=1))
                    sent += 1
                time.sleep(0.002)
            offered = sent / (time.monotonic() - start)
            answers = sum(future.code() is grpc.StatusCode.OK
                          for future in futures)
            return answers / (time.monotonic() - start), offered

        # What else the machine does in between is no fault of the server's: of
        # a few rounds, one has to do.
        ratios = []
        for _ in range(3):
            peak = max(measure_peak(1.5) for _ in range(2))
            goodput, offered = measure_goodput(5 * peak, 4)
            print(f"peak {peak:.0f}/s, offered {offered:.0f}/s, "
                  f"goodput {goodput:.0f}/s = {goodput / peak:.2f}")
            assert offered > 4.5 * peak
            ratios.append(goodput / peak)
            if ratios[-1] >= 0.8:
                break
        assert max(ratios) >= 0.8
