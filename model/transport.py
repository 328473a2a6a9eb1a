"""The closed-form cross-ray transform: Proposition 1 of CR-NeRF, corrected.

Notation: F^cr ~ N(mu_cr, S_cr) are the features of rays, F^a ~ N(mu_a, S_a) those of the reference photo's
cells, C channels; T(F) = T (F - mu_cr) + mu_a. S^1/2 is the symmetric positive square root.

Problem (the paper's, for Gaussians and independent F^a, F^cr): among the T that match the two distributions
exactly, T S_cr T^T = S_a, find the one with the least E|T(F^cr) - F^a|^2 + beta E|P T(F^cr) - F^cr|^2, for a
given invertible P (C, C) and beta > 0.

Derivation: once the distributions match, everything but the cross term is constant, and the objective is
const - 2 beta tr(P T S_cr). So beta drops out (only its sign matters), and so does the alignment loss: P alone
decides. Every feasible T is S_a^1/2 Q S_cr^-1/2 with Q orthogonal, for which tr(P T S_cr) = tr(A Q) with
A = S_cr^1/2 P S_a^1/2 = U D V^T. The largest value, the nuclear norm of A, is taken at Q = V U^T. Hence

    T = P^-1 S_cr^-1/2 M^1/2 S_cr^-1/2  =  S_a P^T S_cr^1/2 M^-1/2 S_cr^-1/2,    M = S_cr^1/2 P S_a P^T S_cr^1/2.

It is the only optimum where A is invertible, that is, where S_cr, S_a and P are. P = identity gives the
optimal-transport map (Lu et al. 2019); the scale of P does not matter.

Where the printed forms go wrong: the main text and the last line of the proof have P^T S_a P in place of
P S_a P^T, which matches the distributions only if the two are equal (a symmetric P, say). The appendix
statement has the right M, but P^-1 at the right end, where it is harmless if it commutes with what it has been
moved past (P = c identity, say).

T is made of second moments alone, so it needs many rays: N of them give a covariance of rank N - 1 at most, and
N > C for S_cr to be invertible. Below that, the eigenvalues that rounding cannot tell from zero are raised to
a floor of 10 epsilon trace(S), epsilon of the input's dtype, and the result is finite but T S_cr T^T = S_a
cannot hold, since T can make no variance where there is none. `covariance` can shrink instead.

All work is done in float64 whatever the input, and M is made as A A^T: it multiplies the condition numbers of both
covariances (at 1e6 each, float32 can end in NaN), and so it cannot come out indefinite.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

ZERO = 1e-60  # floor under the floor: keeps the roots of an all-zero matrix finite


def sqrt_spd(S: Tensor) -> Tensor:
    """S^1/2, symmetric: S (..., C, C), positive semidefinite, float32 or float64 -> (..., C, C).

    Only the symmetric part of S counts. Eigenvalues below 10 epsilon trace(S) count as that. Differentiable once,
    also at equal eigenvalues. ValueError: not square, another dtype, not finite, a clearly negative eigenvalue.
    """
    check_matrices("S", S)
    return roots(S.double(), rounding(S), "S")[0].to(S.dtype)


def inverse_sqrt_spd(S: Tensor) -> Tensor:
    """S^-1/2, symmetric: as `sqrt_spd`, at most (10 epsilon trace(S))^-1/2 in norm.

    ValueError: as `sqrt_spd`, and where S is zero.
    """
    check_matrices("S", S)
    check_not_zero("S", S)
    return roots(S.double(), rounding(S), "S")[1].to(S.dtype)


def transport(content_cov: Tensor, style_cov: Tensor, P: Tensor | None = None) -> Tensor:
    """T of the module's docstring by the form with P^-1: T S_cr T^T = S_a with the largest tr(P T S_cr).

    content_cov S_cr, style_cov S_a, P: (..., C, C) each, whose leading dimensions broadcast, one dtype (float32 or
    float64); P None is the identity -> T (..., C, C). S_a may be singular. Differentiable
    once in all three.
    ValueError: shapes or dtypes that do not fit, values that are not finite, a matrix that is no covariance, a
    content covariance of zero (rays that are all alike), a singular P.
    """
    check_inputs(content_cov, style_cov, P)
    root, inverse_root = roots(content_cov.double(), rounding(content_cov), "content_cov")
    style_root, _ = roots(style_cov.double(), rounding(style_cov), "style_cov")
    if P is not None:
        check_invertible(P)
        P = P.double()
    A = root @ (style_root if P is None else P @ style_root)
    inner, _ = roots(A @ A.mT, rounding(A), "M")
    T = inverse_root @ inner @ inverse_root
    if P is not None:
        T = torch.linalg.solve(P, T)
    return T.to(content_cov.dtype)


def transport_without_inverse(content_cov: Tensor, style_cov: Tensor, P: Tensor | None = None) -> Tensor:
    """T of the module's docstring by the form without P^-1; arguments, result and errors as `transport`.

    P may be singular here: T then carries over only what P sees, and T S_cr T^T is less than S_a.
    """
    check_inputs(content_cov, style_cov, P)
    root, inverse_root = roots(content_cov.double(), rounding(content_cov), "content_cov")
    style_root, _ = roots(style_cov.double(), rounding(style_cov), "style_cov")
    A = root @ (style_root if P is None else P.double() @ style_root)
    _, inverse_inner = roots(A @ A.mT, rounding(A), "M")
    T = style_root @ A.mT @ inverse_inner @ inverse_root  # S_a P^T S_cr^1/2 = S_a^1/2 A^T
    return T.to(content_cov.dtype)


def covariance(features: Tensor, shrinkage: float = 0.0) -> tuple[Tensor, Tensor]:
    """Mean (..., C) and covariance (..., C, C) of features (..., N, C) over their N rays or cells.

    The covariance is the biased one (divided by N, as the second moments of the released code). `shrinkage` s in
    [0, 1] replaces it by (1 - s) S + s trace(S) / C identity: the trace stays, and with s > 0 the rank is full.
    ValueError: no rays, another dtype, values that are not finite, s outside [0, 1].
    """
    if features.ndim < 2 or 0 in features.shape[-2:]:
        raise ValueError(f"a covariance needs features (..., N > 0, C > 0), not {tuple(features.shape)}")
    if not 0.0 <= shrinkage <= 1.0:
        raise ValueError(f"shrinkage {shrinkage} is not in [0, 1]")
    check_values("features", features)
    mean = features.mean(dim=-2)
    centred = features - mean[..., None, :]
    S = centred.mT @ centred / features.shape[-2]
    if shrinkage:
        level = S.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
        S = (1 - shrinkage) * S + shrinkage * level * torch.eye(S.shape[-1], dtype=S.dtype, device=S.device)
    return mean, S


def rounding(S: Tensor) -> float:
    """The part of trace(S) below which an eigenvalue is rounding."""
    return 10 * torch.finfo(S.dtype).eps


def symmetric(S: Tensor) -> Tensor:
    return 0.5 * (S + S.mT)


def roots(S: Tensor, resolution: float, name: str) -> tuple[Tensor, Tensor]:
    """S^1/2 and S^-1/2 of the symmetric part of S, float64."""
    root, inverse_root, smallest = Roots.apply(symmetric(S), resolution)
    trace = S.detach().diagonal(dim1=-2, dim2=-1).sum(-1)
    if bool((smallest < -(resolution**0.5) * trace.abs()).any()):
        raise ValueError(
            f"{name} {tuple(S.shape)} is no covariance: it has the eigenvalue {smallest.min():.3g}; "
            "pass a positive semidefinite matrix"
        )
    return root, inverse_root


class Roots(torch.autograd.Function):
    """S^1/2, S^-1/2 and the smallest eigenvalue of a symmetric S (..., C, C), by one eigendecomposition.

    Backward: X = dS^1/2 solves the Lyapunov equation X S^1/2 + S^1/2 X = dS, in the eigenbasis a division by
    s_i + s_j > 0, s the roots of the eigenvalues. It never divides by a difference of eigenvalues, as autograd
    through the eigenvectors does. d S^-1/2 = -S^-1/2 X S^-1/2. The gradient is that of the floored function.
    """

    @staticmethod
    def forward(ctx: Any, S: Tensor, resolution: float) -> tuple[Tensor, Tensor, Tensor]:
        values, V = torch.linalg.eigh(S)
        floor = resolution * values.sum(-1, keepdim=True)
        s = torch.maximum(values, floor.clamp(min=ZERO)).sqrt()
        ctx.save_for_backward(values, V, s, floor)
        ctx.resolution = resolution
        smallest = values[..., 0]
        ctx.mark_non_differentiable(smallest)
        return (V * s[..., None, :]) @ V.mT, (V / s[..., None, :]) @ V.mT, smallest

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, of_root: Tensor, of_inverse: Tensor, _: Tensor) -> tuple[Tensor, None]:
        values, V, s, floor = ctx.saved_tensors
        above = values > floor.clamp(min=ZERO)
        sum_ij = s[..., :, None] + s[..., None, :]
        product_ij = s[..., :, None] * s[..., None, :]
        X = (V.mT @ symmetric(of_root) @ V - V.mT @ symmetric(of_inverse) @ V / product_ij) / sum_ij

        # Eigenvalues on the floor do not move with S: among themselves nothing changes, against one above the
        # floor the divided difference is that of the floored values over the true ones.
        mixed = above[..., :, None] != above[..., None, :]
        gap = torch.where(mixed, values[..., :, None] - values[..., None, :], 1.0)
        floored_gap = (s.square()[..., :, None] - s.square()[..., None, :]) / gap
        share = torch.where(mixed, floored_gap, (above[..., :, None] & above[..., None, :]).to(X.dtype))
        grad = V @ (share * X) @ V.mT

        # But the floor itself moves with the trace.
        lifted = torch.where(above | (floor < ZERO), 0.0, X.diagonal(dim1=-2, dim2=-1)).sum(-1)
        grad.diagonal(dim1=-2, dim2=-1).add_(ctx.resolution * lifted[..., None])
        return grad, None


def check_values(name: str, x: Tensor) -> None:
    if x.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"{name} {tuple(x.shape)} is {x.dtype}; second moments need float32 or float64")
    if not bool(x.isfinite().all()):
        raise ValueError(f"{name} {tuple(x.shape)} has {int((~x.isfinite()).sum())} values that are not finite")


def check_matrices(name: str, S: Tensor) -> None:
    if S.ndim < 2 or S.shape[-1] != S.shape[-2] or S.shape[-1] == 0:
        raise ValueError(f"{name} must be square matrices (..., C, C), not {tuple(S.shape)}")
    check_values(name, S)


def check_not_zero(name: str, S: Tensor) -> None:
    if bool((S.detach().diagonal(dim1=-2, dim2=-1).sum(-1) <= ZERO).any()):
        raise ValueError(f"{name} {tuple(S.shape)} is zero: where nothing varies there is no inverse root")


def check_inputs(content_cov: Tensor, style_cov: Tensor, P: Tensor | None) -> None:
    given = {"content_cov": content_cov, "style_cov": style_cov} | ({} if P is None else {"P": P})
    for name, matrix in given.items():
        check_matrices(name, matrix)
    shapes = ", ".join(f"{name} {tuple(matrix.shape)}" for name, matrix in given.items())
    if len({matrix.shape[-1] for matrix in given.values()}) > 1:
        raise ValueError(f"the channels differ: {shapes}")
    if len({matrix.dtype for matrix in given.values()}) > 1:
        raise ValueError(f"the dtypes differ: {', '.join(f'{n} {m.dtype}' for n, m in given.items())}")
    try:
        torch.broadcast_shapes(*(matrix.shape for matrix in given.values()))
    except RuntimeError as error:
        raise ValueError(f"the leading dimensions do not broadcast: {shapes}") from error
    check_not_zero("content_cov", content_cov)


def check_invertible(P: Tensor) -> None:
    values = torch.linalg.svdvals(P.detach().double())
    if bool((values[..., -1] <= rounding(P) * values[..., 0]).any()):
        raise ValueError(f"P {tuple(P.shape)} is singular and has no inverse; use transport_without_inverse")
