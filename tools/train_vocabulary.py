"""Train the visual words of `lodelight.mapping.vocabulary` on images.

    python tools/train_vocabulary.py RECORDING ... --out src/lodelight/data/vocabulary.npz

A recording is a folder with images somewhere below it; each gives the same number. k-majority: as k-means, with the
Hamming distance, and with a centre that takes in every bit what most of its descriptors have (Grana, Borghesani,
Manfredi, Cucchiara, "A fast approach for integrating ORB descriptors in the bag of words model", 2013). The same
images in the same order give the same bytes.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from lodelight.compiled import kernel
from lodelight.features.orb import OrbExtractor
from lodelight.geometry.cameras import Camera
from lodelight.mapping.vocabulary import Vocabulary, nearest_words
from lodelight.types import ArrayF32, Ints, Words


@kernel
def majority(desc: Words, member_of: Ints, n_centres: int) -> tuple[Words, Ints]:
    """Centres (K, 4), each bit as most members have it (a tie is 0), and the number of members of each."""
    ones = np.zeros((n_centres, 256), np.int32)
    members = np.zeros(n_centres, np.int32)
    for i in range(len(desc)):
        k = member_of[i]
        members[k] += 1
        for bit in range(256):
            ones[k, bit] += np.int32((desc[i, bit >> 6] >> np.uint64(bit & 63)) & np.uint64(1))
    centres = np.zeros((n_centres, 4), np.uint64)
    for k in range(n_centres):
        for bit in range(256):
            if 2 * ones[k, bit] > members[k]:
                centres[k, bit >> 6] |= np.uint64(1) << np.uint64(bit & 63)
    return centres, members


def nearest(desc: Words, centres: Words) -> Ints:
    """The nearest of all centres: one cell that holds them all."""
    return nearest_words(desc, centres[:1], np.array([0, len(centres)], np.int32), centres, 1)


def k_majority(desc: Words, n_centres: int, rng: np.random.Generator, iterations: int = 25) -> Words:
    """Centres (K, 4) of descriptors (N, 4), until fewer than one in a thousand changes sides."""
    distinct = np.unique(desc, axis=0)
    centres = distinct[rng.permutation(len(distinct))[:n_centres]].copy()
    before = np.full(len(desc), -1, np.int32)
    for _ in range(iterations):
        member_of = nearest(desc, centres)
        if np.mean(member_of != before) < 1e-3:
            break
        before = member_of
        centres, members = majority(desc, member_of, n_centres)
        empty = np.flatnonzero(members == 0)
        centres[empty] = desc[rng.choice(len(desc), len(empty), replace=False)]
    return centres


def train(images: list[Words], n_words: int, n_cells: int, n_samples: int, rng: np.random.Generator) -> Vocabulary:
    """A vocabulary from the descriptors of images, grouped by recording beforehand to weigh them alike."""
    everything = np.concatenate(images)
    chosen = np.sort(rng.permutation(len(everything))[:n_samples])
    centres = k_majority(everything[chosen], n_words, rng)
    cells = k_majority(centres, n_cells, rng)
    cell_of = nearest(centres, cells)
    centres = centres[np.argsort(cell_of, kind="stable")]
    first = np.searchsorted(np.sort(cell_of), np.arange(len(cells) + 1)).astype(np.int32)
    unweighted = Vocabulary(centres, cells, first, np.ones(len(centres), np.float32))
    return Vocabulary(centres, cells, first, inverse_document_frequency(unweighted, images))


def inverse_document_frequency(vocabulary: Vocabulary, images: list[Words]) -> ArrayF32:
    containing = np.zeros(len(vocabulary))
    for desc in images:
        containing[np.unique(vocabulary.words(desc))] += 1
    idf: ArrayF32 = np.log((len(images) + 1) / (containing + 1)).astype(np.float32)
    return idf


def descriptors(recording: Path, n_images: int) -> Iterator[Words]:
    """Descriptors of `n_images` images spread evenly over a recording."""
    paths = sorted(p for p in recording.rglob("*") if p.suffix in (".png", ".jpg") and "depth" not in p.as_posix())
    if not paths:
        raise SystemExit(f"{recording} has no png or jpg below it; check the folder")
    for i in np.unique(np.linspace(0, len(paths) - 1, n_images).astype(int)):
        image = cv2.imread(str(paths[i]), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise SystemExit(f"{paths[i]} is not a readable image; remove it")
        height, width = image.shape
        anywhere = Camera.create("radtan", width, height, (width, width, width / 2, height / 2))
        extractor = OrbExtractor(anywhere)
        yield extractor.extract(extractor.pyramid(image)).desc


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("recordings", nargs="+", type=Path, help="folders with images")
    arguments.add_argument("--out", type=Path, required=True)
    arguments.add_argument("--images", type=int, default=100, help="images taken of each recording")
    arguments.add_argument("--samples", type=int, default=300_000, help="descriptors clustered")
    arguments.add_argument("--words", type=int, default=8192)
    arguments.add_argument("--cells", type=int, default=128)
    arguments.add_argument("--seed", type=int, default=0)
    given = arguments.parse_args()
    images = [desc for recording in given.recordings for desc in descriptors(recording, given.images)]
    vocabulary = train(images, given.words, given.cells, given.samples, np.random.default_rng(given.seed))
    vocabulary.save(given.out)
    print(f"{given.out}: {len(vocabulary)} words from {len(images)} images, {given.out.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
