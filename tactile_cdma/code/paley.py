# SPDX-License-Identifier: Apache-2.0

"""Paley's Hadamard matrices (1933): their rows.

Over a field GF(q) of odd order q = pᵐ let χ be the quadratic character (+1 on squares, −1 on
non-squares, 0 at 0), Q[i, j] = χ(aᵢ − aⱼ), and S = [[0, 1ᵀ], [∓1, Q]]. Then

- I + S is a Hadamard matrix of order q + 1 where q ≡ 3 (mod 4), with −1 in S (construction I);
- S ⊗ [[1, 1], [1, −1]] + I ⊗ [[1, −1], [−1, −1]] is one of order 2(q + 1) where q ≡ 1 (mod 4),
  with +1 in S (construction II). Its column 1 is negated here, so that row 0 is all ones.

Elements are numbered by their coefficients as base-p digits.
"""

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..base.arrays import Indices


@dataclass(frozen=True)
class Paley:
    """The Paley matrix over GF(pᵐ); row 0 is all ones."""

    p: int
    m: int

    @property
    def q(self) -> int:
        """Elements of the field."""
        q: int = self.p**self.m
        return q

    @property
    def doubled(self) -> bool:
        """Whether this is construction II."""
        return self.q % 4 == 1

    def rows(self, indices: Indices) -> NDArray[np.int8]:
        """Some rows, (len(indices), N) int8 of ±1."""
        if not self.doubled:
            rows = self._core_rows(indices)
            rows[np.arange(len(indices)), indices] += 1
            return rows
        half, odd = np.divmod(indices, 2)
        sylvester = np.array([[1, 1], [1, -1]], dtype=np.int8)[odd]
        rows = (self._core_rows(half)[:, :, None] * sylvester[:, None, :]).astype(np.int8)
        rows[np.arange(len(half)), half] = np.array([[1, -1], [-1, -1]], dtype=np.int8)[odd]
        rows[:, 0, 1] *= -1
        return rows.reshape(len(indices), 2 * (self.q + 1))

    def _core_rows(self, indices: Indices) -> NDArray[np.int8]:
        """Rows of S, (len(indices), q + 1) int8."""
        rows = np.empty((len(indices), self.q + 1), dtype=np.int8)
        elements = indices - 1
        difference = np.zeros((len(indices), self.q), dtype=np.int32)
        for weight in self.p ** np.arange(self.m):
            digits = np.arange(self.q) // weight % self.p
            own = elements // weight % self.p
            difference += ((own[:, None] - digits) % self.p * weight).astype(np.int32)
        rows[:, 1:] = self._character[difference]
        rows[:, 0] = 1 if self.doubled else -1
        top = indices == 0
        rows[top, 0], rows[top, 1:] = 0, 1
        return rows

    @cached_property
    def _character(self) -> NDArray[np.int8]:
        """χ of every element, (q,) int8.

        Elements are polynomials modulo one of degree m: the first that makes a field, in which
        x² = y² for x = ±y only, so that there are (q + 1)/2 squares. With divisors of zero,
        (x − y)·(x + y) = 0 has other solutions, and there are fewer.
        """
        p, m = self.p, self.m
        weights = p ** np.arange(m)
        digits = np.arange(self.q)[:, None] // weights % p
        products = np.zeros((self.q, 2 * m - 1), dtype=np.int64)
        for i, j in product(range(m), repeat=2):
            products[:, i + j] += digits[:, i] * digits[:, j]
        for modulus in product(range(1, p), *[range(p)] * (m - 1)):  # without its leading term
            rest = products.copy()
            for top in range(2 * m - 2, m - 1, -1):  # x^m ≡ −modulus
                rest[:, top - m : top] -= rest[:, top : top + 1] * modulus
                rest %= p
            squares = np.unique(rest[:, :m] % p @ weights)
            if 2 * squares.size == self.q + 1:
                break
        character = np.full(self.q, -1, dtype=np.int8)
        character[squares] = 1
        character[0] = 0
        return character


@cache
def paley(order: int) -> Paley | None:
    """Paley's matrix of this order, construction I where there are both; None where neither."""
    for q, residue in ((order - 1, 3), (order // 2 - 1, 1)):
        if q % 4 == residue and (field := _prime_power(q)):
            return Paley(*field)
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
