"""Choose the descriptor's 256 pixel pairs: near-even bits, little correlated, on patches of given image folders.

    python tools/train_descriptor.py FOLDER [FOLDER ...] --out src/lodelight/data/descriptor_pairs.npy

Greedy choice as in Rublee et al. 2011: candidate pairs by how near their mean is to one half, each taken if its
correlation with all taken before stays under a bound, which is raised until there are 256.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

from lodelight.features.corners import find_corners
from lodelight.features.orb import BORDER, PATCH_RADIUS, OrbExtractor, orientations
from lodelight.geometry.cameras import Camera

N_PAIRS = 256
N_CANDIDATES = 8000
MOST_EVEN = 20000
REACH = 13  # farthest sample from the patch's centre, px


def candidate_pairs(rng, count):
    """(count, 4) int: both ends in a disk, at least 4 px apart so that the blur does not make them equal."""
    ends = np.clip(np.rint(rng.normal(0.0, PATCH_RADIUS / 2.2, (6 * count, 4))), -REACH, REACH).astype(int)
    inside = (np.hypot(ends[:, 0], ends[:, 1]) <= REACH) & (np.hypot(ends[:, 2], ends[:, 3]) <= REACH)
    apart = np.hypot(ends[:, 0] - ends[:, 2], ends[:, 1] - ends[:, 3]) >= 4
    return ends[inside & apart][:count]


def bits_of(path, pairs, per_image, rng):
    """(n, pairs) bool: every candidate pair on corners of one image, turned by their orientation."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    height, width = image.shape
    extractor = OrbExtractor(Camera.create("radtan", width, height, (width, width, width / 2, height / 2)))
    rows = []
    for octave, level in enumerate(extractor.pyramid(image)):
        corners = find_corners(level, int(extractor._quota[octave]), extractor.config.fast_threshold, BORDER)
        corners = corners[rng.permutation(len(corners))[: per_image // 8]]
        angle = orientations(level, corners).astype(float)
        smooth = cv2.GaussianBlur(level, (7, 7), 2.0)
        c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]

        def sample(x, y, corners=corners, smooth=smooth, c=c, s=s):
            u = np.rint(c * x - s * y).astype(int) + corners[:, :1]
            v = np.rint(s * x + c * y).astype(int) + corners[:, 1:]
            return smooth[v, u]

        rows.append(sample(pairs[:, 0], pairs[:, 1]) < sample(pairs[:, 2], pairs[:, 3]))
    return np.concatenate(rows)


def choose(bits):
    """Indices of N_PAIRS columns of bits (n, candidates)."""
    mean = bits.mean(axis=0)
    order = np.argsort(np.abs(mean - 0.5), kind="stable")
    deviation = (bits[:, order] - mean[order]).astype(np.float32)
    deviation /= np.maximum(np.linalg.norm(deviation, axis=0), 1e-9)
    correlation = np.abs(deviation.T @ deviation)
    for bound in np.arange(0.15, 1.0, 0.025):
        taken: list[int] = []
        for i in range(len(order)):
            if not taken or correlation[i, taken].max() < bound:
                taken.append(i)
                if len(taken) == N_PAIRS:
                    chosen = order[taken]
                    print(f"correlation bound {bound:.3f}, means {mean[chosen].min():.2f} to {mean[chosen].max():.2f}")
                    return chosen
    raise SystemExit("not enough candidate pairs")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--images", type=int, default=20, help="images per folder")
    parser.add_argument("--per-image", type=int, default=160, help="patches per image")
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    pairs = candidate_pairs(rng, N_CANDIDATES)
    bits = []
    for folder in args.folders:
        images = sorted(p for p in folder.rglob("*") if p.suffix in (".png", ".jpg") and "depth" not in p.as_posix())
        chosen = images[:: max(1, len(images) // args.images)]
        bits += [bits_of(path, pairs, args.per_image, rng) for path in chosen]
    table = np.concatenate(bits)
    print(f"{len(table)} patches, {table.shape[1]} candidate pairs")
    np.save(args.out, pairs[choose(table)].astype(np.int8))


if __name__ == "__main__":
    main()
