"""Work that threads share: each item once, errors reach the caller, and nobody waits for a thread that is not awake."""

import threading

import pytest

from emulator.threads import ThreadPool


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 3, 100])
def test_each_item_is_done_once(threads, count):
    done, pool = [], ThreadPool(threads)
    pool.each(lambda item, thread: done.append((item, thread)), count)
    pool.close()
    assert sorted(item for item, _ in done) == list(range(count))
    assert {thread for _, thread in done} <= set(range(threads))


def test_an_error_in_another_thread_reaches_the_caller():
    pool, met = ThreadPool(2), threading.Barrier(2, timeout=60.0)

    def work(item, thread):
        met.wait()
        if thread == 1:
            raise ValueError("of the other thread")

    with pytest.raises(ValueError, match="of the other thread"):
        pool.each(work, 2)
    pool.close()


def test_threads_have_numbers_of_their_own_at_the_same_time():
    pool, met, seen = ThreadPool(3), threading.Barrier(3, timeout=60.0), []

    def work(item, thread):
        met.wait()
        seen.append(thread)

    pool.each(work, 3)
    pool.close()
    assert sorted(seen) == [0, 1, 2]


def test_nobody_waits_for_a_thread_that_has_not_begun():
    pool, free = ThreadPool(2), threading.Event()
    pool._pool.submit(free.wait, 60.0)  # keeps the other thread busy
    done = []
    pool.each(lambda item, thread: done.append(thread), 4)
    assert done == [0, 0, 0, 0]
    assert not free.is_set()
    free.set()
    pool.close()
