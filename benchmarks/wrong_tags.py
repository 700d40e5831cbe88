"""Wrong tags before the inertial window: `python benchmarks/wrong_tags.py [--trials 1000]`.

On walks among surveyed tags (tests/tag_flights.py: simulated tracks of 0.06 px a step, corners of 0.3 px) a copy of the
odometry is shown three frames with a tag that hangs a metre from its survey, is another print of a tag, is taken for
another, or is turned into the other pose that its corners allow. Told: how many had a say, and in which frame they were
named.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import sys
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from tag_flights import WRONG, TaggedWalk, Trial, trials


def main(wanted: int) -> None:
    done: list[Trial] = []
    seed = 0
    while len(done) < wanted:
        rng = np.random.default_rng(seed)
        for trial in trials(TaggedWalk(seed, 30.0, cameras=1 + seed % 2, count=24), WRONG, 3, rng):
            done.append(trial)
            if len(done) == wanted:
                break
        seed += 1
    print("| wrong tag | trials | had a say | named in frame 1, 2, 3, not | window lost |")
    print("| --- " * 5 + "|")
    for kind in WRONG:
        mine = [t for t in done if t.kind == kind]
        named = Counter(t.named for t in mine)
        when = ", ".join(str(named[k]) for k in (1, 2, 3, 0))
        print(f"| {kind} | {len(mine)} | {sum(t.used > 0 for t in mine)} | {when} | {sum(t.lost for t in mine)} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    main(parser.parse_args().trials)
