"""Times calls next to a yardstick."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np


class Stopwatch:
    """Times calls between repetitions of the yardstick.

    Attributes:
      repetitions: of every call.
      warmups: calls between the first and those that are timed.
    """

    def __init__(self, repetitions: int, warmups: int = 2):
        self.repetitions, self.warmups = repetitions, warmups
        self._matrix = np.random.default_rng(0).normal(size=(1024, 1024)).astype(np.float32)

    def yardstick(self) -> float:
        """Returns the seconds of one 1,024 x 1,024 float32 matrix product of NumPy."""
        # One that is not timed: memory which a large call has just given back costs the next user.
        _ = self._matrix @ self._matrix
        started = time.perf_counter()
        _ = self._matrix @ self._matrix
        return time.perf_counter() - started

    def __call__(
        self, call: Callable[[], Any], check: Callable[[Any], Any] | None = None
    ) -> dict[str, Any]:
        """First call apart, then the check, warm-ups, and interleaved repetitions.

        Args:
          call: waits for its result.
          check: given the first result; raises if it is wrong.

        Returns:
          First call in s; median and minimum of wall time, median CPU time of the process and of
          the yardstick in ms.
        """
        started = time.perf_counter()
        found = call()
        first = time.perf_counter() - started
        if check is not None:
            check(found)
        for _ in range(self.warmups):
            call()
            self.yardstick()
        runs, used, sticks = [], [], []
        for _ in range(self.repetitions):
            sticks.append(self.yardstick())
            started, cpu = time.perf_counter(), time.process_time()
            call()
            runs.append(time.perf_counter() - started)
            used.append(time.process_time() - cpu)
        return {
            "first_call_s": first,
            "median_ms": 1e3 * float(np.median(runs)),
            "min_ms": 1e3 * min(runs),
            "cpu_ms": 1e3 * float(np.median(used)),
            "yardstick_ms": 1e3 * float(np.median(sticks)),
            "repetitions": self.repetitions,
        }
