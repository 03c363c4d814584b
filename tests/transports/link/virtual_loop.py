"""An event loop in the time of a `FakeClock`: it never sleeps, and jumps to the next timer or to the next `at`."""

import asyncio
import heapq
import itertools
import selectors


class VirtualLoop(asyncio.SelectorEventLoop):
    """Event loop whose time is `clock`'s; descriptors that are ready are served before time moves on.

    `sleeps` has the length of each sleep, ns.
    """

    def __init__(self, clock):
        self._planned, self._numbers = [], itertools.count()
        self.sleeps = []
        self.clock = clock
        super().__init__(_Selector(self))

    def time(self):
        return self.clock.now_ns() * 1e-9

    def at(self, t_ns, function):
        """Call `function` at `t_ns`, as another process would: the loop does not know of it."""
        heapq.heappush(self._planned, (t_ns, next(self._numbers), function))

    def sleep(self, timeout_s):
        """Move time on to the end of a sleep, or to the next planned call, and make that call."""
        start_ns = self.clock.now_ns()
        end_ns = start_ns + round(timeout_s * 1e9)
        if self._planned and self._planned[0][0] <= end_ns:
            end_ns, _, function = heapq.heappop(self._planned)
            self.clock.sleep_until(end_ns)
            function()
        else:
            self.clock.sleep_until(end_ns)
        self.sleeps.append(self.clock.now_ns() - start_ns)


class _Selector(selectors.DefaultSelector):
    def __init__(self, loop):
        super().__init__()
        self._loop = loop

    def select(self, timeout=None):
        ready = super().select(0)
        if ready or timeout == 0:
            return ready
        if timeout is None:
            raise AssertionError("the loop would sleep for ever")
        self._loop.sleep(timeout)
        return super().select(0)
