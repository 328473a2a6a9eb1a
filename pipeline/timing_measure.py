"""How a time is taken: warmed up, the device waited for, median and quartiles of repeats, and the most memory held.

A peak beside it: what this machine reaches at best in a matrix product, so that a time can be judged (roofline).
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode

from pipeline.memory import give_back

LEAST = 3  # repeats, however long they take
MOST = 1000  # repeats, however short they are
MIB = 2**20
STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
PRODUCT = {"cuda": 8192, "cpu": 2048}  # rows and columns of the matrices that the peak is measured with


class Seconds(NamedTuple):
    """A measured time: median and quartiles of `repeats`, and the peak memory over them, MiB or None."""

    median: float
    low: float
    high: float
    repeats: int
    memory: float | None = None

    def times(self, factor: float) -> Seconds:
        """Of `factor` as much work."""
        return self._replace(median=factor * self.median, low=factor * self.low, high=factor * self.high)

    def plus(self, other: Seconds) -> Seconds:
        """Of one after the other. Quartiles are added, too, which is as wide as the sum can be."""
        memories = [m for m in (self.memory, other.memory) if m is not None]
        return Seconds(
            self.median + other.median,
            self.low + other.low,
            self.high + other.high,
            min(self.repeats, other.repeats),
            max(memories, default=None),
        )


def summarised(times: list[float], memory: float | None) -> Seconds:
    """Median and quartiles (linear between neighbours) of measured seconds."""
    low, median, high = np.percentile(times, (25, 50, 75))
    return Seconds(float(median), float(low), float(high), len(times), memory)


@dataclass(frozen=True)
class Meter:
    """Takes times on one device.

    Args:
        device: what is waited for.
        seconds: that the repeats of one measurement may take together; LEAST are made in any case.
        clock: seconds.
        agree: makes all ranks take the same number of repeats.
    """

    device: torch.device
    seconds: float
    clock: Callable[[], float] = time.perf_counter
    agree: Callable[[int], int] = lambda repeats: repeats

    def once(self, action: Callable[[], object]) -> float:
        """Seconds of one go, from an idle device to an idle device."""
        self.wait()
        began = self.clock()
        action()
        self.wait()
        return self.clock() - began

    def measure(self, action: Callable[[], object]) -> Seconds:
        """Of an action, after one go that does not count."""
        memory = PeakMemory(self.device)
        action()
        return self.repeated(action, self.once(action), memory)

    def repeated(self, action: Callable[[], object], first: float, memory: PeakMemory) -> Seconds:
        """Of a warm action whose first go took `first` seconds: as many goes as the seconds allow."""
        repeats = self.agree(min(max(int(self.seconds / max(first, 1e-9)), LEAST), MOST))
        times = [first] + [self.once(action) for _ in range(repeats - 1)]
        return summarised(times, memory.peak())

    def wait(self) -> None:
        """Until the device is idle."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


class PeakMemory:
    """The most memory held since it was made, MiB.

    On CUDA what torch's allocator has given out, the model included. On the host what the process grew by above its
    size at the beginning: Linux forgets its record of the peak when it is asked to (proc(5), clear_refs). None on
    systems that do not.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.before: int | None = None
        give_back()  # else what is measured would find room in what was freed, and not be seen to grow
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)
            return
        try:
            CLEAR.write_text("5")
            self.before = resident("VmRSS")
        except OSError:
            return

    def peak(self) -> float | None:
        """Until now."""
        if self.device.type == "cuda":
            return torch.cuda.max_memory_allocated(self.device) / MIB
        return None if self.before is None else max(0, resident("VmHWM") - self.before) / MIB


def memory_of(device: torch.device) -> Literal["host", "cuda"]:
    """Whose memory is looked at."""
    return "cuda" if device.type == "cuda" else "host"


def resident(which: str) -> int:
    """Bytes of this process in memory: `VmRSS` now, `VmHWM` at most (Linux)."""
    match = re.search(rf"^{which}:\s+(\d+) kB", STATUS.read_text(), re.MULTILINE)
    if match is None:
        raise OSError(f"{STATUS} does not tell {which}")
    return int(match[1]) * 1024


def counted_flops(action: Callable[[], object]) -> float:
    """Floating-point operations of an action in matrix products and convolutions, forward and backward."""
    with FlopCounterMode(display=False) as counter:
        action()
    return float(counter.get_total_flops())


def peak_flops(meter: Meter, precision: str, side: int | None = None) -> float:
    """Floating-point operations a second of a large matrix product: what the device reaches at best."""
    n = side or PRODUCT[meter.device.type]
    dtype = torch.bfloat16 if precision == "bfloat16" else torch.float32
    a, b = (torch.rand(n, n, device=meter.device, dtype=dtype) for _ in range(2))
    out = torch.empty_like(a)
    return 2 * n**3 / meter.measure(lambda: torch.mm(a, b, out=out)).median
