"""What ranks tell each other, in real processes: through shared memory, and over gloo where there is none."""

from __future__ import annotations

import multiprocessing
import os
import socket
from functools import partial
from pathlib import Path

import pytest
import torch
import torch.distributed as dist
from torch import nn

from pipeline import shared_memory
from pipeline.averaging import distribute, room
from pipeline.shared_memory import share_memory, this_machine
from pipeline.together import Together
from pipeline.work import Context

pytestmark = pytest.mark.slow

RANKS = 3


def in_ranks(entry, folder: Path, *arguments) -> list:
    """entry(rank, *arguments) in a process each, members of one gloo group; what they return, by rank."""
    with multiprocessing.get_context("spawn").Pool(RANKS) as pool:
        return pool.map(partial(as_rank, entry, str(folder / "store"), arguments), range(RANKS), chunksize=1)


def as_rank(entry, store: str, arguments: tuple, rank: int):
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{store}", rank=rank, world_size=RANKS)
    try:
        return entry(rank, *arguments)
    finally:
        dist.destroy_process_group()


def apart() -> str:
    """In the place of `this_machine`: every rank on another one."""
    return str(dist.get_rank())


def context_of(rank: int) -> Context:
    return Context(rank=rank, world_size=RANKS)


# ----------------------------------------------------------------------------------------------------- exchanges


def exchanges(rank: int) -> list[list[float]]:
    memory = share_memory(4 * 1000)
    found = []
    for turn in range(50):  # other lengths each time, and far more turns than a rank has places
        theirs = memory.exchange(torch.full((1 + 20 * turn,), 1000.0 * turn + rank))
        assert all((t == t[0]).all() and len(t) == 1 + 20 * turn for t in theirs)
        found.append([float(t[0]) for t in theirs])
    return found


def test_everyone_reads_what_everyone_has_said_in_the_order_of_the_ranks(tmp_path):
    expected = [[1000.0 * turn + rank for rank in range(RANKS)] for turn in range(50)]
    assert in_ranks(exchanges, tmp_path) == [expected] * RANKS


def leaves(rank: int) -> bool:
    return len(share_memory(64).exchange(torch.zeros(1))) == RANKS


def test_nothing_is_left_behind(tmp_path):
    before = sorted(Path("/dev/shm").iterdir())
    assert all(in_ranks(leaves, tmp_path))
    assert "@crossray" not in Path("/proc/net/unix").read_text()
    assert sorted(Path("/dev/shm").iterdir()) == before


def one_dies(rank: int) -> str:
    memory = share_memory(64)
    memory.exchange(torch.zeros(1))
    if rank == 1:
        for peer in memory.peers:
            peer.close()  # what the system does for a process that was killed
        return "gone"
    with pytest.raises(RuntimeError) as error:
        memory.exchange(torch.zeros(1))
    return str(error.value)


def test_a_rank_that_has_died_is_an_error_and_nobody_waits_for_it(tmp_path):
    first, _, last = in_ranks(one_dies, tmp_path)
    assert first.startswith("the ranks of this machine have lost one another")
    assert last.startswith("the ranks of this machine have lost one another")


def too_large(rank: int) -> str:
    memory = share_memory(100)
    with pytest.raises(ValueError, match="132 bytes") as error:
        memory.exchange(torch.zeros(33))
    assert len(memory.exchange(torch.zeros(32))) == RANKS  # a place is whole lines of the cache
    return str(error.value)


def test_a_tensor_without_room_is_refused(tmp_path):
    assert in_ranks(too_large, tmp_path) == ["132 bytes, but a rank's place has 128"] * RANKS


def test_a_socket_knows_the_user_at_its_other_end():
    here, there = socket.socketpair()
    with here, there:
        assert shared_memory.user_of(here) == os.getuid()


def test_only_processes_that_reach_each_other_are_on_one_machine(monkeypatch):
    assert this_machine() == this_machine()
    monkeypatch.setattr(shared_memory.sys, "platform", "darwin")
    assert this_machine() is None


# ----------------------------------------------------------------------------------------------- what is agreed on


def agreed(rank: int, machine) -> list:
    shared_memory.this_machine = machine
    ranks = Together(context_of(rank))
    found = [
        ranks.memory is not None,
        ranks.agree(stop=False, seconds=10.0 + rank),
        ranks.agree(stop=rank == 2, seconds=20.0 + rank),
        ranks.numbers(rank, torch.inf if rank == 1 else -rank).tolist(),
    ]
    ranks.same_step(7)
    with pytest.raises(RuntimeError, match="from steps 7 to 8: they see other checkpoints"):
        ranks.same_step(8 if rank == 1 else 7)
    return found


@pytest.mark.parametrize(("machine", "shares"), [(this_machine, True), (apart, False)])
def test_ranks_take_the_first_ones_clock_and_stop_when_any_of_them_is_told(tmp_path, machine, shares):
    numbers = [[0.0, 0.0], [1.0, float("inf")], [2.0, -2.0]]
    assert in_ranks(agreed, tmp_path, machine) == [[shares, (False, 10.0), (True, 20.0), numbers]] * RANKS


def test_one_rank_alone_needs_no_group():
    alone = Together(Context())
    assert alone.agree(stop=True, seconds=3.0) == (True, 3.0)
    assert alone.numbers(1, 2).tolist() == [[1.0, 2.0]]
    alone.same_step(1)


# ------------------------------------------------------------------------------------------------------- averages


class Parts(nn.Module):
    """Two parameters, of which the second is in the first bucket of DDP."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b = nn.Parameter(torch.zeros(1000)), nn.Parameter(torch.zeros(7, 11))

    def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (self.a * a).sum() + (self.b * b).sum()


def gradients_of(rank: int, step: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Numbers whose sum depends on the order in which they are added."""
    generator = torch.Generator().manual_seed(100 * step + rank)
    return torch.randn(1000, generator=generator), 1e-3 * torch.randn(7, 11, generator=generator)


def averaged(rank: int, machine) -> list[tuple[torch.Tensor, torch.Tensor]]:
    shared_memory.this_machine = machine
    model, context = Parts(), context_of(rank)
    ranks = Together(context, room(model, context))
    ddp = distribute(model, context, ranks)
    found = []
    for step in range(3):  # DDP makes its buckets anew after the first step
        ddp(*gradients_of(rank, step)).backward()
        found.append((model.a.grad.clone(), model.b.grad.clone()))
        ddp.zero_grad(set_to_none=True)
        ranks.agree(stop=False, seconds=0.0)  # between two averages, in the same memory
    return found


@pytest.mark.parametrize("machine", [this_machine, apart])
def test_gradients_are_added_up_in_the_order_of_the_ranks(tmp_path, machine):
    """To the bit, in shared memory and over gloo alike; a sum in another order differs."""
    found = in_ranks(averaged, tmp_path, machine)
    for step in range(3):
        (a0, b0), (a1, b1), (a2, b2) = (gradients_of(rank, step) for rank in range(RANKS))
        for ranks_gradients in found:
            a, b = ranks_gradients[step]
            assert torch.equal(a, ((a0 + a1) + a2) / 3)
            assert torch.equal(b, ((b0 + b1) + b2) / 3)
            assert not torch.equal(a, (a0 + (a1 + a2)) / 3)


def test_gradients_of_gpus_stay_with_nccl():
    assert room(Parts(), Context(device=torch.device("cuda", 0))) == 0
    assert room(Parts(), Context()) == 4 * (1000 + 77)
