"""What fits where: nodes made by hand, for each way to place ranks."""

from __future__ import annotations

import pytest

from pipeline.config import make_job
from pipeline.errors import CrossrayError
from pipeline.launch.room import Wanted, check_room, places, wanted, what_fits

SMALL, LARGE = {"CPU": 3.0, "memory": 1e9}, {"CPU": 8.0}
GPUS = {"CPU": 8.0, "GPU": 4.0, "accelerator_type:H100": 1.0}
HEAD = {"memory": 1e9}  # `ray start --head --num-cpus=0`


def want(ranks=4, cpus=1, gpus=0, placement="PACK"):
    return Wanted(ranks, cpus, gpus, placement)


@pytest.mark.parametrize(
    ("nodes", "need", "expected"),
    [
        ([], want(), 0),
        ([HEAD], want(), 0),
        ([SMALL], want(), 3),
        ([SMALL, LARGE], want(cpus=2), 1 + 4),  # whole ranks a node: the third CPU of the small one is of no use
        ([SMALL, LARGE], want(cpus=4), 0 + 2),
        ([SMALL, LARGE], want(cpus=2, placement="SPREAD"), 5),
        ([SMALL, LARGE], want(cpus=2, placement="STRICT_PACK"), 4),
        ([SMALL, LARGE, HEAD], want(cpus=2, placement="STRICT_SPREAD"), 2),
        ([SMALL, LARGE], want(cpus=4, placement="STRICT_SPREAD"), 1),
        ([GPUS, LARGE], want(cpus=1, gpus=1), 4),
        ([GPUS, GPUS], want(cpus=3, gpus=1), 2 + 2),  # GPUs that no CPU is left for
        ([GPUS, {"CPU": 8.0, "GPU": 0.5}], want(gpus=1), 4),
    ],
)
def test_places_count_whole_ranks_on_each_node(nodes, need, expected):
    assert places(nodes, need) == expected


def job(**keys):
    return make_job({"name": "a", "scene": {"path": "."}, **keys})


def test_gpus_are_wanted_where_the_job_or_the_cluster_says_so():
    assert wanted(job(ranks=3, threads=2), [LARGE]) == want(3, 2)
    assert wanted(job(ranks=3, threads=2), [LARGE, GPUS]) == want(3, 2, 1)
    assert wanted(job(device="cpu"), [GPUS]).gpus == 0
    assert wanted(job(device="cuda"), [LARGE]).gpus == 1
    assert wanted(job(threads=2, ray={"cpus_per_rank": 4, "placement": "SPREAD"}), []) == want(1, 4, 0, "SPREAD")


def test_what_ray_is_asked_for_is_what_was_counted():
    assert want(cpus=3, gpus=1).bundle == {"CPU": 3.0, "GPU": 1.0}
    assert want(cpus=3).bundle == {"CPU": 3.0}


@pytest.mark.parametrize(
    ("need", "nodes", "expected"),
    [
        (want(4), [SMALL], [["ranks=3"]]),
        (want(4, cpus=4), [LARGE, LARGE], []),
        (want(5, cpus=4), [LARGE, LARGE], [["ranks=4"], ["ray.cpus_per_rank=2"]]),
        (want(2, placement="STRICT_SPREAD"), [LARGE, HEAD], [["ranks=1"], ["ray.placement=SPREAD"]]),
        (want(9, placement="STRICT_PACK"), [LARGE, SMALL], [["ranks=8"], ["ray.placement=PACK"]]),
        (want(2, gpus=1), [LARGE], [["device=cpu"]]),
        (want(5, gpus=1), [GPUS], [["ranks=4"], ["device=cpu"]]),
        (want(4, cpus=4, gpus=1), [LARGE], [["device=cpu", "ray.cpus_per_rank=2"]]),
        (want(2, cpus=4), [SMALL], [["ray.cpus_per_rank=1"]]),
        (want(9, cpus=16), [LARGE], [["ray.cpus_per_rank=8", "ranks=1"]]),
        (want(9), [HEAD], []),
    ],
)
def test_every_setting_that_is_named_makes_it_fit(need, nodes, expected):
    if places(nodes, need) >= need.ranks:
        check_room(need, nodes)
        assert expected == []
        return
    assert what_fits(need, nodes) == expected
    with pytest.raises(CrossrayError) as error:
        check_room(need, nodes)
    for settings in expected:
        assert " ".join(f"--set {setting}" for setting in settings) in str(error.value)
    keys = dict(pair.split("=") for settings in expected[:1] for pair in settings)
    if keys:
        check_room(
            Wanted(
                int(keys.get("ranks", need.ranks)),
                int(keys.get("ray.cpus_per_rank", need.cpus)),
                0 if keys.get("device") == "cpu" else need.gpus,
                keys.get("ray.placement", need.placement),
            ),
            nodes,
        )


def test_the_message_says_what_is_missing():
    with pytest.raises(CrossrayError) as error:
        check_room(want(8, cpus=2, gpus=1), [LARGE])
    assert str(error.value) == (
        "ranks: the job wants 8 ranks of 2 CPUs and 1 GPU each (ray.placement: PACK), and the cluster has no GPU: 1 "
        "node, 8 CPUs, 0 GPUs; this fits: --set device=cpu --set ray.cpus_per_rank=1"
    )
    with pytest.raises(CrossrayError, match=r"1 rank of 1 CPU \(.*places for 0: 1 node, 0 CPUs.*nothing that can be"):
        check_room(want(1), [HEAD])
