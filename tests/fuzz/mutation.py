"""Damage at random, the same for the same seed: for where there is no coverage to guide it."""

from __future__ import annotations

import random
import re
from collections.abc import Sequence

__all__ = ["mutated"]

_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?")
_MOST_STEPS = 6
_LONGEST_PIECE = 64
_LONGEST = 1 << 16


def mutated(rng: random.Random, seeds: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """Give one of the seeds with a few things changed."""
    data = bytearray(rng.choice(seeds))
    for _ in range(rng.randint(1, _MOST_STEPS)):
        rng.choice(_STEPS)(rng, data, seeds, words)
    return bytes(data[:_LONGEST])


def _place(rng: random.Random, data: bytearray) -> int:
    return rng.randint(0, len(data))


def _flip(rng: random.Random, data: bytearray, *_: object) -> None:
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _set(rng: random.Random, data: bytearray, *_: object) -> None:
    if data:
        data[rng.randrange(len(data))] = rng.choice(
            (0, 1, 9, 10, 32, 127, 128, 255, rng.randrange(256))
        )


def _delete(rng: random.Random, data: bytearray, *_: object) -> None:
    at = _place(rng, data)
    del data[at : at + rng.randint(1, _LONGEST_PIECE)]


def _cut(rng: random.Random, data: bytearray, *_: object) -> None:
    del data[_place(rng, data) :]


def _repeat(rng: random.Random, data: bytearray, *_: object) -> None:
    at = _place(rng, data)
    piece = data[at : at + rng.randint(1, _LONGEST_PIECE)]
    data[at:at] = piece * rng.choice((1, 2, 50))


def _word(rng: random.Random, data: bytearray, seeds: object, words: Sequence[bytes]) -> None:
    if words:
        at = _place(rng, data)
        data[at : at + rng.choice((0, 4, 8))] = rng.choice(words)


def _number(rng: random.Random, data: bytearray, seeds: object, words: Sequence[bytes]) -> None:
    found = list(_NUMBER.finditer(data))
    if found:
        match = rng.choice(found)
        data[match.start() : match.end()] = rng.choice(
            (
                b"0",
                b"-1",
                b"1000000000",
                b"9" * 40,
                b"1e400",
                b"nan",
                b"0.5",
                str(rng.random()).encode(),
            )
        )


def _splice(rng: random.Random, data: bytearray, seeds: Sequence[bytes], words: object) -> None:
    other = rng.choice(seeds)
    at = rng.randint(0, len(other))
    data[_place(rng, data) :] = other[at:]


_STEPS = (_flip, _set, _delete, _cut, _repeat, _word, _number, _splice)
