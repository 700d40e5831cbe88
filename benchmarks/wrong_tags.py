"""Wrong tags before the inertial window: `python benchmarks/wrong_tags.py [--trials 1000]`.

On walks among surveyed tags (tests/tag_flights.py: simulated tracks of 0.06 px a step, corners of 0.3 px) a copy of the
odometry is shown a tag that hangs a metre from its survey, is another print of a tag, is taken for another, or is
turned into the other pose that its corners allow, for three frames, or up to ten where it is not clear. Told: how many
had a say, and in which frame they were named. Beside them right ones, to tell how long they wait for their say.
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

from tag_flights import SIGHTS, WRONG, TaggedWalk, Trial, trials


def main(wanted: int) -> None:
    done: list[Trial] = []
    seed = 0
    while sum(t.kind != "right" for t in done) < wanted:
        rng = np.random.default_rng(seed)
        walk = TaggedWalk(seed, 30.0, cameras=1 + seed % 2, count=48)
        done += trials(walk, ("right", *WRONG), 3, rng)
        seed += 1
    print(f"{seed} walks; up to {SIGHTS} sights a trial")
    print("| tag | trials | had a say | first, in the median | named in frame 1, 2, 3, later, not | window lost |")
    print("| --- " * 6 + "|")
    for kind in ("right", *WRONG):
        mine = [t for t in done if t.kind == kind]
        used = [t.used for t in mine if t.used]
        named = Counter(t.named for t in mine)
        later = sum(n for k, n in named.items() if k > 3)
        when = ", ".join(str(n) for n in (named[1], named[2], named[3], later, named[0]))
        first = f"{np.median(used):.0f}" if used else ""
        print(f"| {kind} | {len(mine)} | {len(used)} | {first} | {when} | {sum(t.lost for t in mine)} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=1000)
    main(parser.parse_args().trials)
