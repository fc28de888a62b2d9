"""Threads beside the caller's own that take their share of a step at once.

Waking a thread takes 50 microseconds and more, a quarter of a step of 16384 environments. A helper therefore looks out for its
next job for a while before it sleeps, as the threads of OpenMP do; meanwhile it holds no lock of Python's.
"""

import ctypes
import os
import platform
import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress
from functools import cache
from typing import Any

from mfc_gym import machine_code
from mfc_gym.compiled import INTERPRETED, Bound

LOOKS = 5_000  # for a job before sleeping: about 100 microseconds
IDLE, POSTED, DONE, ASLEEP = range(4)  # states of a mailbox, [state, function, arguments, result, status]
PAUSE = "call void @llvm.x86.sse2.pause()" if platform.machine() in ("x86_64", "AMD64") else ""

CODE = f"""
{"declare void @llvm.x86.sse2.pause()" if PAUSE else ""}
declare i32 @sched_yield()

define i64 @post(ptr %box, ptr %function, ptr %arguments) {{
    %box1 = getelementptr i64, ptr %box, i64 1
    %box2 = getelementptr i64, ptr %box, i64 2
    store ptr %function, ptr %box1
    store ptr %arguments, ptr %box2
    %before = atomicrmw xchg ptr %box, i64 {POSTED} acq_rel
    ret i64 %before
}}

define void @serve(ptr %box, i64 %looks) {{
begin:
    %box1 = getelementptr i64, ptr %box, i64 1
    %box2 = getelementptr i64, ptr %box, i64 2
    %box3 = getelementptr i64, ptr %box, i64 3
    %box4 = getelementptr i64, ptr %box, i64 4
    br label %look
look:
    %left = phi i64 [%looks, %begin], [%looks, %work], [%less, %rest], [1, %sleep]
    %state = load atomic i64, ptr %box acquire, align 8
    %posted = icmp eq i64 %state, {POSTED}
    br i1 %posted, label %work, label %idle
work:
    %function = load ptr, ptr %box1
    %arguments = load ptr, ptr %box2
    %status = call i32 %function(ptr %arguments, ptr %box3)
    store i32 %status, ptr %box4
    store atomic i64 {DONE}, ptr %box release, align 8
    br label %look
idle:
    %tired = icmp eq i64 %left, 0
    br i1 %tired, label %sleep, label %rest
rest:
    {PAUSE}
    %less = sub i64 %left, 1
    br label %look
sleep:
    %pair = cmpxchg ptr %box, i64 %state, i64 {ASLEEP} acq_rel acquire
    %slept = extractvalue {{i64, i1}} %pair, 1
    br i1 %slept, label %end, label %look
end:
    ret void
}}

define i32 @wait(ptr %box, i64 %looks) {{
begin:
    %box4 = getelementptr i64, ptr %box, i64 4
    br label %look
look:
    %left = phi i64 [%looks, %begin], [%less, %rest], [0, %yield]
    %state = load atomic i64, ptr %box acquire, align 8
    switch i64 %state, label %again [i64 {DONE}, label %end i64 {ASLEEP}, label %end]
again:
    %tired = icmp eq i64 %left, 0
    br i1 %tired, label %yield, label %rest
rest:
    {PAUSE}
    %less = sub i64 %left, 1
    br label %look
yield:
    %ignored = call i32 @sched_yield()
    br label %look
end:
    %status = load i32, ptr %box4
    ret i32 %status
}}
"""


@cache
def _native() -> tuple[Any, Any, Any]:
    """(post, serve, wait)."""
    post, serve, wait = machine_code.assembled(CODE, "post", "serve", "wait")
    pointer, number = ctypes.c_void_p, ctypes.c_int64
    return (
        ctypes.PYFUNCTYPE(number, pointer, pointer, ctypes.c_char_p)(post),
        ctypes.CFUNCTYPE(None, pointer, number)(serve),  # these two let go of Python's lock
        ctypes.CFUNCTYPE(ctypes.c_int32, pointer, number)(wait),
    )


class Helper:
    """One further thread."""

    def __init__(self) -> None:
        self._box = (ctypes.c_int64 * 5)(ASLEEP)
        self._asleep = threading.Lock()  # held as long as there is nothing to do
        self._asleep.acquire()
        self._job: Bound | None = None
        threading.Thread(target=self._serve, name="mfc_gym", daemon=True).start()

    def _serve(self) -> None:
        _, serve, _ = _native()
        while True:
            self._asleep.acquire()
            serve(ctypes.addressof(self._box), LOOKS)

    def _wake(self) -> None:
        with suppress(RuntimeError):  # of a lock that is not held: it has been woken
            self._asleep.release()

    def start(self, job: Bound) -> None:
        """Begins a job; the helper must have none."""
        post, _, _ = _native()
        self._job = job
        if post(ctypes.addressof(self._box), job.address, job.arguments) == ASLEEP:
            self._wake()

    def wait(self) -> int:
        """The status of the job, once it is done; of the one before, if it was not begun."""
        _, _, wait = _native()
        if self._box[0] == POSTED:
            self._wake()  # an interrupt may have come before
        status = int(wait(ctypes.addressof(self._box), LOOKS))
        self._job = None
        return status


def cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _helpers() -> tuple[list[Helper], threading.Lock]:
    """The helpers of the process, and the lock of those who use them."""
    return [Helper() for _ in range(cores() - 1)], threading.Lock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_helpers.cache_clear)  # threads do not survive a fork


def _statuses(helpers: Iterable[Helper]) -> dict[Helper, int]:
    """Of the last jobs of these helpers, once all are done, whatever the user interrupts: they write where the caller reads."""
    found: dict[Helper, int] = {}
    interrupt: KeyboardInterrupt | None = None
    for helper in helpers:
        while helper not in found:
            try:
                found[helper] = helper.wait()
            except KeyboardInterrupt as error:
                interrupt = error
    if interrupt is not None:
        raise interrupt
    return found


def run(jobs: Sequence[Bound]) -> None:
    """All jobs at once, as far as there are helpers and nobody else has them. Raises ArithmeticError if one fails."""
    first, *others = jobs
    if not others or INTERPRETED:
        for job in jobs:
            job()
        return
    helpers, free = _helpers()
    if not free.acquire(blocking=False):
        helpers = []
    try:
        shared = dict(zip(helpers, others, strict=False))
        try:
            for helper, job in shared.items():
                helper.start(job)
            for job in (first, *others[len(shared) :]):
                job()
        finally:
            statuses = _statuses(shared)
        for helper, job in shared.items():
            job.check(statuses[helper])
    finally:
        if helpers:
            free.release()
