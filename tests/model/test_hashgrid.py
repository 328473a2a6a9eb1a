"""The hash encoding against a slow one that loops over points, levels and corners with Python's integers."""

from __future__ import annotations

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from model.fields import hashgrid, hashgrid_cpu
from model.fields.hashgrid import HashEncoding


def big_hash(i: int, j: int, k: int, entries: int) -> int:
    """Equation 4 of Instant-NGP, in integers of any size."""
    return (i ^ (j * 2_654_435_761) ^ (k * 805_459_861)) % entries


def slow_lookup(table: Tensor, resolutions: list[int], entries: int, x: Tensor) -> Tensor:
    """Features (N, L F) of x (N, 3), by double loops."""
    rows = []
    for point in x.tolist():
        features = []
        for level, r in enumerate(resolutions):
            side = r + 1
            cell = [math.floor(c * r) for c in point]
            inside = [c * r - f for c, f in zip(point, cell, strict=True)]
            total = torch.zeros(table.shape[1], dtype=torch.float64)
            for corner in itertools.product((0, 1), repeat=3):
                i, j, k = (c + d for c, d in zip(cell, corner, strict=True))
                dense = side**3 <= entries
                row = i + j * side + k * side**2 if dense else big_hash(i, j, k, entries)
                weight = math.prod(f if d else 1 - f for f, d in zip(inside, corner, strict=True))
                total += weight * table[level * entries + row].double()
            features.append(total)
        rows.append(torch.cat(features))
    return torch.stack(rows)


@pytest.fixture(autouse=True, params=["compiled", "torch"])
def route(request, monkeypatch):
    """Everything here holds for both routes of the look-up on a CPU."""
    monkeypatch.setattr(hashgrid, "HAS_NUMBA", request.param == "compiled")
    return request.param


def encoding_with_random_table(**sizes) -> HashEncoding:
    encoding = HashEncoding(**sizes)
    torch.nn.init.normal_(encoding.table, generator=torch.Generator().manual_seed(0))
    return encoding


def random_points(count: int) -> Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(1))


def test_resolutions_grow_geometrically_and_end_at_the_last():
    assert HashEncoding(8, 8, 8, 512).resolutions.tolist() == [8, 14, 26, 47, 86, 156, 282, 512]
    assert HashEncoding(5, 13, 8, 128).resolutions.tolist() == [8, 16, 32, 64, 128]
    assert HashEncoding(1, 8, 4, 64).resolutions.tolist() == [4]


def test_dense_and_hashed_levels_equal_the_slow_lookup():
    # Sides 4, 7, 13, 25; 4^3 and 7^3 entries fit into 512.
    encoding = encoding_with_random_table(levels=4, log2_entries=9, min_resolution=3, max_resolution=24)
    assert encoding.num_dense == 2
    x = random_points(40)
    expected = slow_lookup(encoding.table.detach(), [3, 6, 12, 24], 512, x)
    assert encoding(x).shape == (40, encoding.out_channels) == (40, 8)
    torch.testing.assert_close(encoding(x).double(), expected, atol=2e-5, rtol=0)


def test_all_dense_and_all_hashed():
    for sizes, resolutions in (((2, 12, 4, 8), [4, 8]), ((2, 4, 4, 8), [4, 8])):
        encoding = encoding_with_random_table(
            **dict(zip(("levels", "log2_entries", "min_resolution", "max_resolution"), sizes, strict=True))
        )
        x = random_points(20)
        expected = slow_lookup(encoding.table.detach(), resolutions, 2 ** sizes[1], x)
        torch.testing.assert_close(encoding(x).double(), expected, atol=1e-5, rtol=0)


@settings(deadline=None, max_examples=25)
@given(cell=st.tuples(*[st.integers(0, 4095)] * 3))
def test_the_int32_hash_equals_the_big_integer_hash(cell):
    encoding = HashEncoding(levels=1, log2_entries=15, min_resolution=4096, max_resolution=4096)
    index, _ = encoding.corners((torch.tensor([cell]) + 0.5) / 4096)
    # Corner number i + 2 j + 4 k.
    expected = [
        big_hash(cell[0] + i, cell[1] + j, cell[2] + k, 2**15) for k, j, i in itertools.product((0, 1), repeat=3)
    ]
    assert index[:, 0].tolist() == expected


def test_weights_are_a_partition_of_one():
    encoding = HashEncoding(4, 9, 3, 24)
    index, weight = encoding.corners(random_points(50))
    assert index.shape == weight.shape == (8, 4 * 50)
    assert (weight >= 0).all()
    torch.testing.assert_close(weight.sum(0), torch.ones(200))
    level = torch.arange(4).repeat_interleave(50)
    assert (index // 512 == level).all()  # no level reads another's entries


def set_linear(encoding: HashEncoding, slope: Tensor, offset: Tensor) -> None:
    """Dense tables that hold slope x + offset at their vertices: slope (F, 3), offset (F,)."""
    with torch.no_grad():
        for level, r in enumerate(int(r) for r in encoding.resolutions):
            k, j, i = torch.meshgrid(*[torch.arange(r + 1)] * 3, indexing="ij")
            vertices = torch.stack([i, j, k], dim=-1).reshape(-1, 3) / r
            first = level * encoding.entries
            encoding.table[first : first + len(vertices)] = vertices @ slope.T + offset


SLOPE, OFFSET = torch.tensor([[1.0, -2.0, 0.5], [0.0, 3.0, -1.0]]), torch.tensor([0.25, -4.0])


def test_dense_levels_reproduce_a_linear_function():
    encoding = HashEncoding(levels=3, log2_entries=12, min_resolution=3, max_resolution=12)
    assert encoding.num_dense == 3
    set_linear(encoding, SLOPE, OFFSET)
    x = torch.cat([random_points(50), torch.zeros(1, 3)])
    expected = (x @ SLOPE.T + OFFSET).repeat(1, 3)
    torch.testing.assert_close(encoding(x), expected, atol=1e-5, rtol=0)


@pytest.mark.parametrize("point", [(1.0, 1.0, 1.0), (1.0, 0.3, 0.6), (0.2, 0.7, 1.0)])
@pytest.mark.parametrize("resolution", [12, 15])  # with 15 the level fills its table to the last entry
def test_the_upper_faces_belong_to_the_cube(point, resolution):
    """The forward pass promises [0, 1]^3, and the contraction gives exactly 1 for a point far away."""
    encoding = HashEncoding(levels=1, log2_entries=12, min_resolution=resolution, max_resolution=resolution)
    assert encoding.num_dense == 1
    set_linear(encoding, SLOPE, OFFSET)
    x = torch.tensor([point])
    torch.testing.assert_close(encoding(x), x @ SLOPE.T + OFFSET, atol=1e-5, rtol=0)


def test_the_table_gradient_equals_autograd_through_indexing():
    encoding = encoding_with_random_table(levels=4, log2_entries=9, min_resolution=3, max_resolution=24)
    x = random_points(30).repeat(3, 1)  # the same cells several times: gradients must add up
    cotangent = torch.randn(90, 8, generator=torch.Generator().manual_seed(2))
    (encoding(x) * cotangent).sum().backward()

    table = encoding.table.detach().clone().requires_grad_()
    index, weight = encoding.corners(x)
    plain = (table[index.long()] * weight[..., None]).sum(0)  # (L N, F)
    plain = plain.view(4, 90, 2).permute(1, 0, 2).reshape(90, 8)
    torch.testing.assert_close(encoding(x), plain, atol=1e-6, rtol=0)
    (plain * cotangent).sum().backward()
    torch.testing.assert_close(encoding.table.grad, table.grad, atol=1e-5, rtol=0)
    assert (table.grad != 0).any()
    assert (encoding.table.grad == 0).any()  # entries that no point touches


def test_no_gradient_reaches_the_points():
    encoding = encoding_with_random_table(levels=2, log2_entries=9, min_resolution=3, max_resolution=6)
    x = random_points(5).requires_grad_()
    encoding(x).sum().backward()
    assert x.grad is None


def test_buffers_stay_out_of_checkpoints():
    assert list(HashEncoding(2, 8, 3, 6).state_dict()) == ["table"]


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf, -0.25, 1e30])
def test_what_is_no_point_touches_nothing_outside_the_table(wrong):
    """Weights that have run away give such points: the loss has to say so, not the operating system."""
    encoding = encoding_with_random_table(levels=4, log2_entries=9, min_resolution=3, max_resolution=24)
    x = random_points(3)
    x[1, 2] = wrong
    found = encoding(x)
    right = encoding(x[[0, 2]])
    assert torch.equal(found[[0, 2]], right)
    assert found[1].isfinite().all() == math.isfinite(wrong)
    found.sum().backward()
    assert encoding.table.grad.shape == encoding.table.shape


def test_both_routes_give_the_same_at_the_sizes_of_the_fast_field(monkeypatch):
    encoding = encoding_with_random_table(levels=12, log2_entries=15, min_resolution=8, max_resolution=512)
    x, cotangent = random_points(2000), torch.randn(2000, 24, generator=torch.Generator().manual_seed(2))
    found = []
    for compiled in (True, False):
        monkeypatch.setattr(hashgrid, "HAS_NUMBA", compiled)
        encoding.table.grad = None
        out = encoding(x)
        out.backward(cotangent)
        found.append((out.detach(), encoding.table.grad))
    torch.testing.assert_close(found[0], found[1], atol=1e-5, rtol=0)


def test_doubles_take_torchs_route():
    encoding = encoding_with_random_table(levels=4, log2_entries=9, min_resolution=3, max_resolution=24)
    single, double = encoding(random_points(40)), encoding.double()(random_points(40).double())
    assert double.dtype == torch.float64
    torch.testing.assert_close(single.double(), double, atol=1e-5, rtol=0)


@pytest.mark.parametrize("problem", [RuntimeError("no locator"), OSError(28, "No space left on device")])
def test_without_a_folder_for_what_is_compiled_it_is_compiled_anew(monkeypatch, problem):
    made = hashgrid_cpu.numba.njit

    def njit(*arguments, cache=False, **options):
        if cache:
            raise problem
        return made(*arguments, **options)

    monkeypatch.setattr(hashgrid_cpu.numba, "njit", njit)
    assert hashgrid_cpu.compiled("float32(float32)")(lambda x: x + x)(1.5) == 3
