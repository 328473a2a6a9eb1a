"""Whether a cluster can hold the ranks of a job, and what to set where it cannot."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from pipeline.config import Job
from pipeline.errors import CrossrayError

Node = dict[str, float]  # what Ray counts on a node: {"CPU": 16.0, "GPU": 8.0, ...}


@dataclass(frozen=True)
class Wanted:
    """What the ranks of a job take of a cluster."""

    ranks: int
    cpus: int
    """CPUs of one rank."""
    gpus: int
    """GPUs of one rank: 0 or 1."""
    placement: str
    """Ray's placement strategy."""

    @property
    def bundle(self) -> Node:
        """One rank's share, as Ray counts it."""
        return {"CPU": float(self.cpus)} | ({"GPU": float(self.gpus)} if self.gpus else {})

    def __str__(self) -> str:
        share = f"{self.cpus} CPU{'s' * (self.cpus > 1)}" + " and 1 GPU" * self.gpus
        return f"1 rank of {share}" if self.ranks == 1 else f"{self.ranks} ranks of {share} each"


def alive_nodes() -> list[Node]:
    """What each node of the cluster has in all."""
    import ray

    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


def wanted(job: Job, nodes: Sequence[Node]) -> Wanted:
    """What the job takes: GPUs where it says so, and with `device: auto` where the cluster has any."""
    gpus = job.device == "cuda" or (job.device == "auto" and any(node.get("GPU", 0) for node in nodes))
    return Wanted(job.ranks, job.ray.cpus_per_rank or job.threads, int(gpus), job.ray.placement)


def places(nodes: Sequence[Node], need: Wanted) -> int:
    """How many ranks like these the nodes hold when nothing else runs there."""
    held = [min(int(node.get(kind, 0) // amount) for kind, amount in need.bundle.items()) for node in nodes]
    match need.placement:
        case "STRICT_PACK":  # all on one node
            return max(held, default=0)
        case "STRICT_SPREAD":  # each on a node of its own
            return sum(count > 0 for count in held)
        case _:
            return sum(held)


def check_room(need: Wanted, nodes: Sequence[Node]) -> None:
    """Refuse what would wait for ever.

    Raises:
        CrossrayError: the nodes cannot hold the ranks; the message says what is missing and what would fit.
    """
    fit = places(nodes, need)
    if fit >= need.ranks:
        return
    cpus, gpus = (sum(node.get(kind, 0) for node in nodes) for kind in ("CPU", "GPU"))
    has = "no GPU" if need.gpus and not gpus else f"places for {fit}"
    remedies = [" ".join(f"--set {setting}" for setting in settings) for settings in what_fits(need, nodes)]
    raise CrossrayError(
        f"ranks: the job wants {need} (ray.placement: {need.placement}), and the cluster has {has}: {len(nodes)} "
        f"node{'s' * (len(nodes) != 1)}, {cpus:g} CPUs, {gpus:g} GPUs; "
        + (f"this fits: {', or '.join(remedies)}" if remedies else "nothing that can be set would fit")
    )


def what_fits(need: Wanted, nodes: Sequence[Node]) -> list[list[str]]:
    """Settings each of which makes the job fit; with fewer ranks where nothing else does."""
    alone: dict[str, list[str]] = {}
    fewer: dict[str, list[str]] = {}
    for settings, other in other_ways(need):
        fit, key = places(nodes, other), settings[0].partition("=")[0]
        if fit >= need.ranks:
            alone.setdefault(key, settings)
        elif fit:
            fewer.setdefault(key, [*settings, f"ranks={fit}"])
    fit = places(nodes, need)
    if fit:
        return [[f"ranks={fit}"], *alone.values()]
    return list((alone or fewer).values())


def other_ways(need: Wanted) -> Iterator[tuple[list[str], Wanted]]:
    """Other ways to place the ranks; of those that change the same key, the nearest first."""
    if need.placement.startswith("STRICT"):
        placement = need.placement.removeprefix("STRICT_")
        yield [f"ray.placement={placement}"], replace(need, placement=placement)
    for cpus in range(need.cpus - 1, 0, -1):
        yield [f"ray.cpus_per_rank={cpus}"], replace(need, cpus=cpus)
    if need.gpus:
        yield ["device=cpu"], replace(need, gpus=0)
        for cpus in range(need.cpus - 1, 0, -1):
            yield ["device=cpu", f"ray.cpus_per_rank={cpus}"], replace(need, gpus=0, cpus=cpus)
