"""Hadamard code books of any feasible order, and the pseudo-random signs of their rows.

A code book is a matrix C of ±1 with C·Cᵀ = N·I. Three constructions cover the orders:

- Sylvester (1867): [[1, 1], [1, -1]], and its Kronecker powers;
- Paley I (1933): order q + 1 for a prime power q ≡ 3 (mod 4);
- Paley II: order 2(q + 1) for a prime power q ≡ 1 (mod 4);

and the Kronecker product of two Hadamard matrices is one again. Powers of two are always
Sylvester's matrix in natural order, which is also what MATLAB's and scipy's `hadamard` give.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache, reduce
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import SpecError

MAX_ORDER = 65_536


@dataclass(frozen=True)
class CodeBook:
    """A Hadamard matrix, kept as its Kronecker factors.

    factors: square int8 matrices of ±1; the book is their Kronecker product, the first factor
        varying slowest.
    """

    factors: tuple[NDArray[np.int8], ...]

    @cached_property
    def order(self) -> int:
        """Number of rows, and of chips per bit."""
        return math.prod(len(factor) for factor in self.factors)

    @cached_property
    def matrix(self) -> NDArray[np.int8]:
        """The whole book, (N, N) int8 of ±1; row 0 is all ones. N² bytes: meant for small N."""
        return reduce(np.kron, self.factors)

    def rows(self, indices: ArrayLike) -> NDArray[np.int8]:
        """Chosen rows, (len(indices), N) int8, without forming the matrix."""
        remaining = np.asarray(indices, dtype=np.intp)
        if remaining.size and not 0 <= remaining.min() <= remaining.max() < self.order:
            raise SpecError(f"code rows run from 0 to {self.order - 1}, got {indices!r}")
        rows = np.ones((remaining.size, 1), dtype=np.int8)
        for factor in reversed(self.factors):
            remaining, digit = np.divmod(remaining, len(factor))
            width = rows.shape[1] * len(factor)
            rows = (factor[digit][:, :, None] * rows[:, None, :]).reshape(remaining.size, width)
        return rows


@lru_cache(maxsize=32)
def code_book(order: int) -> CodeBook:
    """The code book of this order.

    Raises SpecError, naming the nearest feasible orders, where no construction applies.
    """
    if not 1 <= order <= MAX_ORDER:
        raise SpecError(f"code order {order} is outside 1…{MAX_ORDER}")
    plan = _plan(order)
    if plan is None:
        below = next(n for n in range(order - 1, 0, -1) if is_feasible(n))
        raise SpecError(
            f"no Hadamard matrix of order {order} can be built; "
            f"the nearest feasible orders are {below} and {smallest_order(order)}"
        )
    factors = tuple(_primitive(block) for block in plan)
    for factor in factors:
        factor.setflags(write=False)
    return CodeBook(factors)


def is_feasible(order: int) -> bool:
    """Whether one of the constructions yields a Hadamard matrix of this order."""
    return order >= 1 and _plan(order) is not None


def smallest_order(rows: int) -> int:
    """The smallest feasible order with at least this many rows.

    Raises SpecError above MAX_ORDER rows.
    """
    if not 1 <= rows <= MAX_ORDER:
        raise SpecError(f"{rows} code rows needed; orders run from 1 to {MAX_ORDER}")
    return next(order for order in range(rows, 2 * rows + 1) if is_feasible(order))


def row_signs(rows: NDArray[np.intp], seed: int | None) -> NDArray[np.int8]:
    """The fixed sign of each code row, (len(rows),) int8 of ±1; None gives natural (all +1) signs.

    Random signs keep the peak of the summed line near √n instead of n when all nodes send the
    same word. The sign is the top bit of MurmurHash3's 32-bit finalizer of seed + row·φ, cheap
    enough for a node's microcontroller to compute for itself.
    """
    if seed is None:
        return np.ones(len(rows), dtype=np.int8)
    golden, mask = 0x9E3779B9, 0xFFFFFFFF
    h = (np.uint64(seed) + np.asarray(rows, dtype=np.uint64) * np.uint64(golden)) & np.uint64(mask)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        h = ((h ^ (h >> np.uint64(shift))) * np.uint64(factor)) & np.uint64(mask)
    h ^= h >> np.uint64(16)
    return np.where(h >> np.uint64(31), -1, 1).astype(np.int8)


@cache
def _plan(order: int) -> tuple[int, ...] | None:
    """Orders of the primitive factors with the least total size; None where none exists.

    The total size of the factors is what a Kronecker transform costs per element.
    """
    if order == 1:
        return (1,)
    if order & (order - 1) == 0:
        return (2,) * (order.bit_length() - 1)
    if order % 4:
        return None
    plans: list[tuple[int, ...]] = [(order,)] if _paley_field(order) else []
    for small in (d for d in range(2, int(order**0.5) + 1) if order % d == 0):
        left, right = _plan(small), _plan(order // small)
        if left and right:
            plans.append(tuple(sorted(left + right)))
    return min(plans, key=lambda plan: (sum(plan), plan), default=None)


def _primitive(order: int) -> NDArray[np.int8]:
    """A normalised (row 0 all ones) Hadamard matrix of order 1, 2 or a Paley order."""
    if order == 1:
        return np.ones((1, 1), dtype=np.int8)
    if order == 2:
        return np.array([[1, 1], [1, -1]], dtype=np.int8)
    field = _paley_field(order)
    assert field is not None, "the plan holds only primitive orders"
    q = field[0] ** field[1]
    core = np.zeros((q + 1, q + 1), dtype=np.int8)
    core[0, 1:] = 1
    core[1:, 0] = -1 if q % 4 == 3 else 1
    core[1:, 1:] = _jacobsthal(*field)
    if q % 4 == 3:
        matrix = core + np.eye(q + 1, dtype=np.int8)
    else:
        eye = np.eye(q + 1, dtype=np.int8)
        matrix = np.kron(core, np.array([[1, 1], [1, -1]], dtype=np.int8)) + np.kron(
            eye, np.array([[1, -1], [-1, -1]], dtype=np.int8)
        )
    normalised: NDArray[np.int8] = (matrix * matrix[0]).astype(np.int8)
    return normalised


def _paley_field(order: int) -> tuple[int, int] | None:
    """(p, m) of the field GF(pᵐ) behind Paley's matrix of this order, construction I first."""
    for q, residue in ((order - 1, 3), (order // 2 - 1, 1)):
        if q % 4 == residue and (field := _prime_power(q)):
            return field
    return None


def _prime_power(q: int) -> tuple[int, int] | None:
    """(p, m) with pᵐ = q, or None."""
    if q < 2:
        return None
    p = next((d for d in range(2, int(q**0.5) + 1) if q % d == 0), q)
    m = 0
    while q % p == 0:
        q, m = q // p, m + 1
    return (p, m) if q == 1 else None


def _jacobsthal(p: int, m: int) -> NDArray[np.int8]:
    """χ(aᵢ − aⱼ) over GF(pᵐ), (q, q) int8; χ is +1 on squares, −1 on non-squares, 0 at 0.

    Elements are numbered by their coefficients as base-p digits.
    """
    q = p**m
    weights = p ** np.arange(m)
    digits = np.arange(q)[:, None] // weights % p
    modulus = _irreducible(p, m)
    squares = np.zeros((q, 2 * m - 1), dtype=np.int64)
    for i, j in product(range(m), repeat=2):
        squares[:, i + j] += digits[:, i] * digits[:, j]
    for top in range(2 * m - 2, m - 1, -1):  # x^m ≡ −(modulus without its leading term)
        squares[:, top - m : top] -= squares[:, top : top + 1] * modulus[:m]
        squares %= p
    character = np.full(q, -1, dtype=np.int8)
    character[squares[:, :m] % p @ weights] = 1
    character[0] = 0
    difference = np.zeros((q, q), dtype=np.int32)
    for digit, weight in zip(digits.T, weights, strict=True):
        difference += ((digit[:, None] - digit[None, :]) % p * weight).astype(np.int32)
    return character[difference]


def _irreducible(p: int, m: int) -> NDArray[np.int64]:
    """The first monic irreducible polynomial of degree m over GF(p): m + 1 rising coefficients."""
    for low in product(range(p), repeat=m):
        candidate = np.array([*low, 1])
        divisors = (
            np.array([*rest, 1])
            for d in range(1, m // 2 + 1)
            for rest in product(range(p), repeat=d)
        )
        if all(_remainder(candidate, divisor, p).any() for divisor in divisors):
            return candidate
    raise AssertionError("an irreducible polynomial exists for every degree")


def _remainder(
    dividend: NDArray[np.int64], divisor: NDArray[np.int64], p: int
) -> NDArray[np.int64]:
    """Remainder of a division by a monic polynomial over GF(p), rising coefficients."""
    rest, degree = dividend.copy(), len(divisor) - 1
    for top in range(len(rest) - 1, degree - 1, -1):
        rest[top - degree : top + 1] = (rest[top - degree : top + 1] - rest[top] * divisor) % p
    return rest[:degree]
