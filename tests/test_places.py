"""Place recognition: words, the inverted index, candidates."""

from __future__ import annotations

import numpy as np
import pytest

from lodelight.features.features import Features
from lodelight.geometry.cameras import Camera
from lodelight.geometry.se3 import SE3
from lodelight.mapping.map import Map
from lodelight.mapping.places import Places
from lodelight.mapping.vocabulary import PROBES, Vocabulary
from lodelight.rig import CameraSpec, Rig

BITS = 256


def flipped(rng, desc, p):
    """Descriptors with every bit turned with probability p."""
    bits = np.unpackbits(desc.view(np.uint8), axis=1)
    return np.packbits(bits ^ (rng.random(bits.shape) < p), axis=1).view(np.uint64)


def random_descriptors(rng, n):
    return rng.integers(0, 2**64, (n, BITS // 64), dtype=np.uint64)


def all_distances(a, b):
    return np.bitwise_count(a[:, None] ^ b[None]).sum(axis=2)


@pytest.fixture
def vocabulary():
    """640 words in 20 cells, each cell a cluster, with idf of several sizes."""
    rng = np.random.default_rng(1)
    cells = random_descriptors(rng, 20)
    centres = flipped(rng, np.repeat(cells, 32, axis=0), 0.15)
    idf = rng.uniform(0.0, 3.0, 640).astype(np.float32)
    return Vocabulary(centres, cells, np.arange(0, 641, 32, dtype=np.int32), idf)


def features_of(desc):
    n = len(desc)
    f32 = np.zeros(n, np.float32)
    return Features(np.zeros((n, 2), np.float32), np.zeros(n, np.int32), f32, desc, np.zeros((n, 3)), f32, f32)


def map_of(images):
    camera = Camera.create("radtan", 640, 480, (500.0, 500.0, 320.0, 240.0))
    map = Map(Rig((CameraSpec("cam0", camera, SE3.identity()),)))
    for i, desc in enumerate(images):
        map.add_keyframe(i, SE3.identity(), features_of(desc))
    return map


def images_of(rng, vocabulary, n, size=200):
    return [flipped(rng, vocabulary.centres[rng.integers(0, 640, size)], 0.05) for _ in range(n)]


def bag(vocabulary, desc):
    """Plain numpy twin: the image's whole vector, with L1 norm 1."""
    weight = np.bincount(vocabulary.words(desc), minlength=len(vocabulary)) * vocabulary.idf.astype(np.float64)
    return weight / weight.sum()


def test_a_word_is_the_nearest_centre_when_all_cells_are_looked_at(vocabulary):
    desc = random_descriptors(np.random.default_rng(2), 300)
    everywhere = Vocabulary(vocabulary.centres, vocabulary.cells[:1], np.array([0, 640], np.int32), vocabulary.idf)
    distance = all_distances(desc, vocabulary.centres)
    words = everywhere.words(desc)
    assert words.dtype == np.int32
    np.testing.assert_array_equal(words, distance.argmin(axis=1))


def test_a_few_cells_give_almost_always_the_nearest_centre(vocabulary):
    rng = np.random.default_rng(3)
    desc = flipped(rng, vocabulary.centres[rng.integers(0, 640, 500)], 0.1)
    assert len(vocabulary.cells) > PROBES
    assert np.mean(vocabulary.words(desc) == all_distances(desc, vocabulary.centres).argmin(axis=1)) > 0.99


def test_a_vocabulary_survives_its_file(vocabulary, tmp_path):
    vocabulary.save(tmp_path / "v.npz")
    loaded = Vocabulary.load(tmp_path / "v.npz")
    desc = random_descriptors(np.random.default_rng(4), 100)
    np.testing.assert_array_equal(loaded.words(desc), vocabulary.words(desc))
    np.testing.assert_allclose(loaded.idf, vocabulary.idf, rtol=1e-3)  # stored in half precision


def test_similarity_is_one_minus_half_the_l1_distance_of_the_bags(vocabulary):
    rng = np.random.default_rng(5)
    images = images_of(rng, vocabulary, 30)
    places = Places(map_of(images), vocabulary)
    for query in (images[3], images_of(rng, vocabulary, 1)[0]):
        score, common = places.similarity(query)
        mine = bag(vocabulary, query)
        theirs = np.array([bag(vocabulary, desc) for desc in images])
        np.testing.assert_allclose(score, 1.0 - 0.5 * np.abs(theirs - mine).sum(axis=1), atol=1e-5)  # float32 sums
        seen = set(vocabulary.words(query).tolist())
        np.testing.assert_array_equal(common, [len(seen & set(vocabulary.words(d).tolist())) for d in images])


def test_the_index_follows_a_map_that_gains_and_loses_keyframes(vocabulary):
    rng = np.random.default_rng(6)
    images = images_of(rng, vocabulary, 60)
    query = images_of(rng, vocabulary, 1)[0]
    map = map_of(images[:20])
    places = Places(map, vocabulary)
    for start in (20, 40):
        places.follow()
        for desc in images[start : start + 20]:
            map.add_keyframe(0, SE3.identity(), features_of(desc))
        for keyframe in rng.permutation(start)[:15]:
            map.keyframes.alive[keyframe] = False
    score, common = places.similarity(query)
    score_anew, common_anew = Places(map, vocabulary).similarity(query)
    np.testing.assert_array_equal(score, score_anew)
    np.testing.assert_array_equal(common, common_anew)
    assert not common[~map.keyframes.alive].any()
    assert common[map.keyframes.alive].all()


def test_candidates_are_the_alike_but_never_the_excluded(vocabulary):
    rng = np.random.default_rng(7)
    images = images_of(rng, vocabulary, 40)
    places = Places(map_of(images), vocabulary)
    again = flipped(rng, images[11], 0.02)
    assert places.candidates(again, limit=3).tolist() == [11]
    found = places.similarity(again)
    assert 11 not in places.best(*found, limit=3, excluded=np.array([11]))
    assert len(places.best(*found, limit=3, excluded=np.arange(40))) == 0
    assert len(places.best(*found, limit=3, min_score=1.01)) == 0


def test_of_a_neighbourhood_that_looks_alike_only_the_best_is_a_candidate(vocabulary):
    rng = np.random.default_rng(8)
    images = images_of(rng, vocabulary, 20)
    images += [flipped(rng, images[4], 0.04) for _ in range(3)]
    map = map_of(images)
    points = map.add_points(np.zeros((50, 3)), np.arange(50) + map.keyframes.first_feature[4], 4)
    for keyframe in (20, 21, 22):
        map.link(np.arange(50) + map.keyframes.first_feature[keyframe], points)
    assert Places(map, vocabulary).candidates(images[4], limit=3).tolist() == [4]


def test_an_empty_index_and_an_empty_image_have_no_candidates(vocabulary):
    rng = np.random.default_rng(9)
    images = images_of(rng, vocabulary, 5)
    assert len(Places(map_of([]), vocabulary).candidates(images[0], limit=3)) == 0
    assert len(Places(map_of(images), vocabulary).candidates(np.zeros((0, 4), np.uint64), limit=3)) == 0
