import threading
import time
from contextlib import closing

from services.acquisition.clock import HostWatch, StationClock, VirtualClock


def run_all(targets):
    threads = [threading.Thread(target=target, daemon=True) for target in targets]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
        assert not thread.is_alive()


def test_virtual_time_jumps_in_order():
    clock = VirtualClock(0)
    seen = []

    def participant(waiter, times):
        with closing(waiter):
            for t_ns in times:
                assert waiter.wait_until(t_ns)
                seen.append((clock.now_ns(), t_ns))

    plans = [range(0, 10_000, 7), range(3, 10_000, 11), range(5, 10_000, 1000)]
    waiters = [clock.waiter(drives_time=True) for _ in plans]
    run_all([lambda w=w, p=p: participant(w, p) for w, p in zip(waiters, plans, strict=True)])
    assert all(now == wanted for now, wanted in seen)
    assert [now for now, _ in seen] == sorted(now for now, _ in seen)
    assert clock.now_ns() == max(plan[-1] for plan in plans)


def test_virtual_time_stands_while_someone_works():
    clock = VirtualClock(0)
    working, waiting = clock.waiter(), clock.waiter(drives_time=True)
    done = threading.Event()

    def wait():
        waiting.wait_until(100)
        done.set()

    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    assert not done.wait(0.05)
    assert clock.now_ns() == 0
    working.close()
    assert done.wait(5)
    assert clock.now_ns() == 100


def test_virtual_time_stands_when_nobody_drives_it():
    clock = VirtualClock(0)
    follower = clock.waiter()
    results = []
    thread = threading.Thread(target=lambda: results.append(follower.wait_until(10)), daemon=True)
    thread.start()
    thread.join(0.05)
    assert clock.now_ns() == 0
    follower.cancel()
    thread.join(5)
    assert results == [False]


def test_past_targets_return_at_once():
    clock = VirtualClock(50)
    assert clock.waiter().wait_until(10)
    assert clock.now_ns() == 50


def test_real_clock_waits_and_is_cancelled():
    clock = StationClock()
    waiter = clock.waiter()
    start_ns = clock.now_ns()
    assert waiter.wait_until(start_ns + 2_000_000)
    assert clock.now_ns() >= start_ns + 2_000_000
    waiter.cancel()
    assert not waiter.wait_until(clock.now_ns() + 60_000_000_000)


def test_a_thread_that_is_held_up_between_two_clocks_has_seen_no_wall_clock_set():
    class HeldUpClock(StationClock):
        held_up_ns, num_left = 0, 0

        def read_ns(self, clock_id):
            now_ns = super().read_ns(clock_id) + self.held_up_ns
            if clock_id == time.CLOCK_REALTIME and self.num_left:
                self.num_left -= 1
                self.held_up_ns += 300_000_000
            return now_ns

    clock = HeldUpClock()
    watch = HostWatch(clock)
    clock.num_left = 1
    watch.look()
    watch.look()
    assert watch.problems() == ()
