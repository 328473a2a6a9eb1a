"""Memory that all ranks of one machine share: what each has to say is read by the others where it was written.

Gradients through a loopback network cost two ranks a quarter of a fast step (benchmarks/results/speed.md). Here a rank
writes into its own place and says so to each other rank, one byte through a socket; a rank that has died is known by
its closed socket. The memory has no name in any file system and the sockets have none either, so nothing is left behind
by whatever kills a rank, and only processes of the same user are let in.
"""

from __future__ import annotations

import mmap
import os
import socket
import struct
import sys
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

LINE = 64  # bytes of a cache line: where each place begins
PATIENCE = 1800.0  # seconds that a rank waits for another one, as torch.distributed does


class SharedMemory:
    """One place of `size` bytes a rank, twice: while others read what was said last, a rank may say the next.

    Args:
        peers: a connected socket to each other rank.
    """

    def __init__(self, descriptor: int, rank: int, world_size: int, size: int, peers: list[socket.socket]) -> None:
        self.rank, self.peers = rank, peers
        self.size = -(-size // LINE) * LINE
        self.turn = 0
        whole = torch.frombuffer(mmap.mmap(descriptor, 2 * world_size * self.size), dtype=torch.uint8)
        self.places = whole.view(2, world_size, self.size)

    def exchange(self, mine: Tensor) -> list[Tensor]:
        """What each rank has given, by rank; all give tensors of one shape and type. To be read before the next but one
        exchange.

        Raises:
            RuntimeError: another rank has ended, or has not come for half an hour; this one's sockets are closed then.
            ValueError: a tensor that has no room.
        """
        length = mine.numel() * mine.element_size()
        if length > self.size:
            raise ValueError(f"{length} bytes, but a rank's place has {self.size}")
        self.turn = 1 - self.turn
        theirs = [place[:length].view(mine.dtype).view(mine.shape) for place in self.places[self.turn]]
        theirs[self.rank].copy_(mine)
        self.wait()
        return theirs

    def wait(self) -> None:
        """Until all ranks are here."""
        try:
            for peer in self.peers:
                peer.sendall(b".")
            for peer in self.peers:
                if not peer.recv(1):
                    raise RuntimeError("another rank of this machine has ended")
        except (OSError, RuntimeError) as error:
            for peer in self.peers:  # so that nobody waits for this rank either
                peer.close()
            raise RuntimeError(f"the ranks of this machine have lost one another: {error}") from error


def share_memory(size: int, group: dist.ProcessGroup | None = None) -> SharedMemory | None:
    """Memory with `size` bytes for each rank of a group; None unless all are on one machine that can do it.

    All ranks call this at once.
    """
    rank, world_size = dist.get_rank(group), dist.get_world_size(group)
    said: list[Any] = [None] * world_size
    dist.all_gather_object(said, (this_machine(), os.urandom(16).hex()), group)
    machines = {machine for machine, _ in said}
    if None in machines or len(machines) > 1:
        return None
    peers = connect([secret for _, secret in said], rank, group)
    if rank == 0:
        descriptor = os.memfd_create("crossray")
        os.ftruncate(descriptor, 2 * world_size * -(-size // LINE) * LINE)
        for peer in peers:
            socket.send_fds(peer, [b"m"], [descriptor])
    else:
        descriptor = socket.recv_fds(peers[0], 1, 1)[1][0]
    try:
        return SharedMemory(descriptor, rank, world_size, size, peers)
    finally:
        os.close(descriptor)  # the mapping stays


def this_machine() -> str | None:
    """What tells machines, and containers that cannot reach each other, apart; None where memory cannot be shared so.

    Only x86 shows one process's writes to another in their order without being told to.
    """
    if sys.platform != "linux" or os.uname().machine != "x86_64":
        return None
    try:
        os.close(os.memfd_create("crossray"))
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot} {Path('/proc/self/ns/net').stat().st_ino} {os.getuid()}"
    except OSError:
        return None


def connect(secrets: list[str], rank: int, group: dist.ProcessGroup | None) -> list[socket.socket]:
    """A socket to each other rank, by rank; a rank listens at its secret. All ranks call this at once."""
    peers: dict[int, socket.socket] = {}
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(address(secrets[rank]))
        listener.listen(len(secrets))
        listener.settimeout(PATIENCE)
        dist.barrier(group)  # everyone listens
        for other in range(rank):
            peers[other] = socket.socket(socket.AF_UNIX)
            peers[other].settimeout(PATIENCE)
            peers[other].connect(address(secrets[other]))
            peers[other].send(struct.pack("i", rank))
        while len(peers) < len(secrets) - 1:
            peer, _ = listener.accept()
            if user_of(peer) != os.getuid():
                peer.close()
                continue
            peer.settimeout(PATIENCE)
            peers[struct.unpack("i", peer.recv(4))[0]] = peer
    return [peers[other] for other in sorted(peers)]


def address(secret: str) -> str:
    """An abstract one, which no file stands for."""
    return f"\0crossray-{secret}"


def user_of(peer: socket.socket) -> int:
    """Who is at the other end of a socket of this machine."""
    credentials = peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    return struct.unpack("3i", credentials)[1]
