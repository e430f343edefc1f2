"""A condition whose waits can be interrupted."""

from __future__ import annotations

import threading
from typing import Optional

#: The longest that the main thread waits at a time, in seconds.
INTERRUPT_SECONDS = 0.5


class Condition(threading.Condition):
    """Lets the main thread hear Ctrl-C. Python loses an interrupt that comes just
    before it begins to wait for a lock: it hears of it once that wait is over, which
    without a time may be never. So the main thread waits for a short time only, and
    `wait()` returns without a cause then, as it may anyway."""

    def wait(self, timeout: Optional[float] = None) -> bool:
        if threading.current_thread() is threading.main_thread():
            timeout = (INTERRUPT_SECONDS if timeout is None
                       else min(timeout, INTERRUPT_SECONDS))
        return super().wait(timeout)
