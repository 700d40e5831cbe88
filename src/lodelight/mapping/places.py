"""Which keyframes look like this one: an inverted index over their visual words.

Every word has a list of the keyframes that show it, with the word's share in their whole; the similarity of two
images is what their shares have in common, sum of min(a, b), in [0, 1] (Nister and Stewenius 2006, with the L1 norm).
Words are found anew when a map is loaded: 1 ms a keyframe, and the file stays free of the vocabulary.
"""

from __future__ import annotations

import numpy as np

from lodelight.compiled import kernel
from lodelight.mapping.map import Map
from lodelight.mapping.vocabulary import Vocabulary
from lodelight.types import AnyArray, ArrayF32, Bools, Ints, Words

COMMON_WORDS = 0.8  # of the most that any keyframe shares: fewer, and it is no candidate
PLACE_SIZE = 10  # covisible keyframes that make one place with a keyframe, and add their scores to its own
LOOKED_AT = 15  # keyframes, the most similar: a bound on the time of a query


@kernel
def bag_of_words(words: Ints, idf: ArrayF32) -> tuple[Ints, ArrayF32]:
    """The distinct words of an image, rising, and their shares: term frequency times idf, with sum 1."""
    ordered = np.sort(words)
    distinct = np.empty(len(words), np.int32)
    share = np.zeros(len(words), np.float32)
    n = 0
    total = 0.0
    for w in ordered:
        if n == 0 or distinct[n - 1] != w:
            distinct[n] = w
            n += 1
        share[n - 1] += idf[w]
        total += idf[w]
    if total > 0.0:
        share /= np.float32(total)
    return distinct[:n].copy(), share[:n].copy()


@kernel
def insert(keyframe: int, words: Ints, shares: ArrayF32, lists: Ints, keyframe_of: Ints, share_of: ArrayF32) -> None:
    """Append (keyframe, share) to the words' lists. `lists` (W, 3) = first, count, room; there must be room."""
    for i in range(len(words)):
        w = words[i]
        at = lists[w, 0] + lists[w, 1]
        keyframe_of[at] = keyframe
        share_of[at] = shares[i]
        lists[w, 1] += 1


@kernel
def erase(keyframe: int, words: Ints, lists: Ints, keyframe_of: Ints, share_of: ArrayF32) -> None:
    """Take a keyframe out of the words' lists. Their order changes; no sum depends on it."""
    for w in words:
        first, last = lists[w, 0], lists[w, 0] + lists[w, 1] - 1
        for at in range(first, last + 1):
            if keyframe_of[at] == keyframe:
                keyframe_of[at] = keyframe_of[last]
                share_of[at] = share_of[last]
                lists[w, 1] -= 1
                break


@kernel
def enlarge(words: Ints, end: int, lists: Ints, keyframe_of: Ints, share_of: ArrayF32) -> int:
    """Move the full ones of the words' lists to the end of the pool, with twice the room; returns the new end."""
    for w in words:
        first, count, room = lists[w, 0], lists[w, 1], lists[w, 2]
        if count == room:
            keyframe_of[end : end + count] = keyframe_of[first : first + count]
            share_of[end : end + count] = share_of[first : first + count]
            lists[w, 0] = end
            lists[w, 2] = max(4, 2 * room)
            end += lists[w, 2]
    return end


@kernel
def compare(
    words: Ints, shares: ArrayF32, lists: Ints, keyframe_of: Ints, share_of: ArrayF32, n_keyframes: int
) -> tuple[ArrayF32, Ints]:
    """Similarity to every keyframe, and how many distinct words they have in common."""
    score = np.zeros(n_keyframes, np.float32)
    common = np.zeros(n_keyframes, np.int32)
    for i in range(len(words)):
        first = lists[words[i], 0]
        for at in range(first, first + lists[words[i], 1]):
            k = keyframe_of[at]
            score[k] += min(shares[i], share_of[at])
            common[k] += 1
    return score, common


class Places:
    """The index of a map's keyframes. It follows the map by itself: every query first takes in what has changed."""

    def __init__(self, map: Map, vocabulary: Vocabulary | None = None) -> None:
        self.map = map
        self.vocabulary = vocabulary or Vocabulary.shipped()
        self._lists = np.zeros((len(self.vocabulary), 3), np.int32)
        self._keyframe_of = np.zeros(1 << 14, np.int32)
        self._share_of = np.zeros(1 << 14, np.float32)
        self._end = 0
        self._indexed = np.zeros(0, np.bool_)

    def follow(self) -> None:
        """Take in the keyframes that are new in the map, and let go of those that are gone."""
        with self.map.lock:
            alive = self.map.keyframes.alive
            indexed = np.zeros(len(alive), np.bool_)
            indexed[: len(self._indexed)] = self._indexed
            for keyframe in np.flatnonzero(indexed & ~alive).tolist():
                words, _ = self.describe(self._desc(keyframe))
                erase(keyframe, words, self._lists, self._keyframe_of, self._share_of)
            for keyframe in np.flatnonzero(alive & ~indexed).tolist():
                words, shares = self.describe(self._desc(keyframe))
                self._make_room(words)
                insert(keyframe, words, shares, self._lists, self._keyframe_of, self._share_of)
            self._indexed = alive.copy()

    def describe(self, desc: Words) -> tuple[Ints, ArrayF32]:
        """The distinct words of descriptors (N, 4), and their shares."""
        return bag_of_words(self.vocabulary.words(desc), self.vocabulary.idf)

    def similarity(self, desc: Words) -> tuple[ArrayF32, Ints]:
        """Similarity in [0, 1] of descriptors (N, 4) to every keyframe of the map, and their distinct common words."""
        self.follow()
        words, shares = self.describe(desc)
        return compare(words, shares, self._lists, self._keyframe_of, self._share_of, len(self._indexed))

    def candidates(self, desc: Words, limit: int, excluded: AnyArray | None = None) -> Ints:
        """Keyframes that look most like descriptors (N, 4), as `best` chooses them."""
        return self.best(*self.similarity(desc), limit, excluded)

    def best(
        self, score: ArrayF32, common: Ints, limit: int, excluded: AnyArray | None = None, min_score: float = 0.0
    ) -> Ints:
        """Keyframes with the best `similarity`, one of each place, the best place first.

        excluded : keyframes that are no answer; min_score : similarity below which none is.
        A place is a keyframe with its covisible ones: one image may look alike by chance, a neighbourhood less so.
        Source: science note B2.
        """
        allowed = np.ones(len(score), np.bool_)
        if excluded is not None:
            allowed[excluded] = False
        most = common[allowed].max(initial=0)
        similar: Bools = allowed & (common > 0) & (common >= COMMON_WORDS * most) & (score >= min_score)
        chosen = np.flatnonzero(similar)
        chosen = chosen[np.argsort(-score[chosen], kind="stable")][:LOOKED_AT]
        return self._best_of_places(chosen, score, similar, limit)

    def _best_of_places(self, chosen: AnyArray, score: ArrayF32, similar: Bools, limit: int) -> Ints:
        """Of keyframes, best first, those that no better one is covisible with, by the score of all that are."""
        claimed = np.zeros(len(score), np.bool_)
        places: list[tuple[float, int]] = []
        for keyframe in chosen.tolist():
            if not claimed[keyframe]:
                around, _ = self.map.covisible(keyframe)
                members = np.append(keyframe, around[:PLACE_SIZE])
                claimed[members] = True
                places.append((float(score[members[similar[members]]].sum()), keyframe))
        places.sort(key=lambda place: -place[0])
        return np.array([keyframe for _, keyframe in places[:limit]], np.int32)

    def _desc(self, keyframe: int) -> Words:
        desc: Words = self.map.features.desc[self.map.feature_range(keyframe)]
        return desc

    def _make_room(self, words: Ints) -> None:
        full = self._lists[words, 1] == self._lists[words, 2]
        needed = self._end + int(np.maximum(4, 2 * self._lists[words[full], 2]).sum())
        if needed > len(self._keyframe_of):
            self._keyframe_of = _grown(self._keyframe_of, needed)
            self._share_of = _grown(self._share_of, needed)
        self._end = enlarge(words, self._end, self._lists, self._keyframe_of, self._share_of)


def _grown(column: AnyArray, needed: int) -> AnyArray:
    out = np.zeros(max(needed, len(column) + len(column) // 4), column.dtype)
    out[: len(column)] = column
    return out
