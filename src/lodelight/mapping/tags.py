"""Tags in a map: seen, judged, mapped; surveyed ones tie the map to the world, the others close loops.

Everything happens in the map's own frame, which nothing but a correction moves. `T_world_map` stands beside it from the
moment a surveyed tag has been mapped; at the end the whole map is expressed in the world.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from lodelight.anchors import Tag
from lodelight.features.orb import OrbConfig
from lodelight.geometry.se3 import SE3
from lodelight.mapping.map import Map
from lodelight.mapping.tag_alignment import consensus, looseness, off_m
from lodelight.mapping.tag_corners import tag_world
from lodelight.mapping.tag_correction import correct_by_tags
from lodelight.mapping.tag_views import find_tag, misfit_px, pose_of_view, tag_key, tag_name, views_of
from lodelight.messages import Frame, TagSighting
from lodelight.tags.detect import TagConfig, TagDetector
from lodelight.tags.gate import GateConfig, KnownTag, TagGate, Verdict
from lodelight.tags.survey import MappedTag, SurveyConfig, Unmapped, map_tag
from lodelight.types import Array

EventSink = Callable[..., None]  # called as sink(t_ns, kind, **fields)


@dataclass(frozen=True)
class MapTagsConfig:
    """use : look for tags at all. families : besides QR codes and those the anchors name, blank-separated
    default_size_m : of tags whose size nothing tells; 0 = such tags are of no use
    apart_m, apart_deg : views of one tag nearer to each other than this say the same twice
    max_views : of one tag from which its place is found
    correct_px : misfit of a placed tag's corners after local mapping above which the whole map is bent
    iterations : of the adjustment of the whole map after that
    """

    use: bool = True
    families: str = ""
    default_size_m: float = 0.0
    apart_m: float = 0.05
    apart_deg: float = 3.0
    max_views: int = 24
    correct_px: float = 1.5
    iterations: int = 10
    detect: TagConfig = field(default_factory=lambda: TagConfig(families="qr"))
    gate: GateConfig = field(default_factory=GateConfig)
    survey: SurveyConfig = field(default_factory=SurveyConfig)


TELLING_VIEWS = 6  # of a tag that do not agree, before it is named: of three one may well be poor
VISIT_NS = 10_000_000_000  # views further apart are of two visits


class MapTags:
    """The tags of one map. `see` runs with tracking, `note` when a frame has been located, `process` with mapping.

    T_world_map : None until a surveyed tag is mapped, or where the map was loaded in the world
    on_event : told of tags found wrong, of the alignment and of corrections
    """

    def __init__(
        self, map: Map, orb: OrbConfig, sigma_px: float, tags: Iterable[Tag] = (), config: MapTagsConfig | None = None,
        on_event: EventSink | None = None, upright: bool = False,
    ) -> None:  # fmt: skip
        """upright : the map has z up, by an IMU, which has a say in the map's last adjustment"""
        self.upright = upright
        self.map, self.orb, self.sigma_px = map, orb, sigma_px
        self.config = config or MapTagsConfig()
        self.emit: EventSink = on_event or (lambda t_ns, kind, **fields: None)
        self.spec = map.rig.cameras[0]
        tags = list(tags)
        families = {*self.config.families.split(), *(tag.family for tag in tags)}
        self.detector = TagDetector(self.spec.camera, families, self.config.detect)
        self.book = TagGate(tags, self.config.gate)  # in the world's frame: what is surveyed and what payloads claim
        self.gate = TagGate((), self.config.gate, self._named)  # in the map's
        self.T_world_map: SE3 | None = None
        self._told: set[str] = set()
        self._fresh: set[int] = set()  # tags with views that came since they were mapped last
        self._alignment: list[str] = []  # surveyed tags that the alignment rests on
        self._distrusted: set[str] = set()  # tags whose survey proved wrong
        self._doubt = False  # two tags contradicted the alignment, and agreed with each other
        self._recall()

    # -- with tracking ------------------------------------------------------------------------------------------

    def see(self, frame: Frame) -> list[TagSighting]:
        """The tags in a frame whose size is known."""
        if not self.config.use:
            return []
        found = self.detector.detect(frame.images[0], frame.t_ns)
        for refused in self.detector.refused:
            self._tell(frame.t_ns, refused.name, "refused", refused.why)
        return [sized for s in found if (sized := self._sized(s)) is not None]

    def note(
        self, sightings: Sequence[TagSighting], reference: int, T_reference_body: SE3, covariance: Array, own: bool
    ) -> bool:
        """Judge the sightings of a located frame, and keep the views that say something new.

        Returns whether surveyed tags agree that the frame is elsewhere.
        own : the frame is the keyframe `reference` itself; covariance (6, 6) of its pose, before tags had a say
        """
        if not sightings:
            return False
        T_map_body = self.map.pose(reference) @ T_reference_body
        for s in sightings:
            if (s.family, s.id) not in self.gate.tags:
                self._expect(s)
        verdicts = self.gate.judge(sightings, self.spec, T_map_body, covariance)
        for verdict in verdicts:
            tag = find_tag(self.map, verdict.sighting.name)
            disputed = verdict.kind == "contradicts" and self._disputable(tag)
            if (verdict.usable or verdict.kind == "new" or disputed) and (own or self._apart(tag, T_map_body)):
                self._keep(tag, verdict, reference, T_reference_body, own)
                second = verdict.usable and self._disputable(tag) and verdict.sighting.name not in self._alignment
                self._doubt |= disputed or second or verdict.kind == "corrects"
        if self.T_world_map is None and self._fresh:  # not before the next keyframe, but now
            self._map_fresh(sightings[0].t_ns)
            self._align(sightings[0].t_ns)
        return any(v.kind == "corrects" and v.tag is not None and v.tag.surveyed for v in verdicts)

    # -- with mapping -------------------------------------------------------------------------------------------

    def process(self, keyframe: int, stop: Callable[[], bool] | None = None) -> None:
        """Map the tags that were seen since, align the map with the world, bend it where tags say it is bent."""
        with self.map.lock:
            t_ns = int(self.map.keyframes.t_ns[keyframe])
            self._map_fresh(t_ns)
            self._align(t_ns)
            worst_px = misfit_px(self.map, keyframe)
        if worst_px > self.config.correct_px:
            self._correct(t_ns, worst_px, stop)

    def prepare(self) -> None:
        """Before the last adjustment of the whole map: place every tag, and bend the map where it does not fit them."""
        if not len(self.map.tags):
            return
        t_ns = self._settle()
        worst = max((misfit_px(self.map, int(k)) for k in self.map.alive_keyframes), default=0.0)
        if worst > self.config.correct_px:
            self._correct(t_ns, worst, None)

    def finish(self) -> None:
        """After it: the last word on every tag; then the whole map moves into the world."""
        if not len(self.map.tags):
            return
        self._settle()
        if self.T_world_map is not None:
            self.map.move(self.T_world_map)
            self.T_world_map = SE3.identity()

    def _settle(self) -> int:
        t_ns = int(self.map.keyframes.t_ns[self.map.alive_keyframes[-1]])
        self._fresh = set(range(len(self.map.tags)))
        self._map_fresh(t_ns)
        self._align(t_ns)
        return t_ns

    def moved(self) -> None:
        """Something else than tags laid the map down in the world: surveyed tags are where their survey has them."""
        self.T_world_map = SE3.identity()
        for i in np.flatnonzero(self.map.tags.placed).tolist():
            self._place(i, tag_world(self.map, i), self.map.tags.covariance[i].copy())
            self._survey(i)

    @property
    def aligned(self) -> bool:
        return self.T_world_map is not None

    def world(self, T_map_body: SE3) -> SE3:
        """A pose in the world, or as it is where the map has not been aligned."""
        return T_map_body if self.T_world_map is None else self.T_world_map @ T_map_body

    def world_covariance(self, covariance: Array) -> Array:
        """(6, 6) of a pose, its position turned into the world's axes."""
        if self.T_world_map is None:
            return covariance
        turned = np.eye(6)
        turned[3:, 3:] = self.T_world_map.R
        out: Array = turned @ covariance @ turned.T
        return out

    def surveys(self) -> dict[str, KnownTag]:
        """Surveyed tags by name that are not known to be wrong, where they hang in the map's frame; none before it is
        aligned."""
        if self.T_world_map is None:
            return {}
        T_map_world, out = self.T_world_map.inverse(), {}
        for (family, id), known in self.book.tags.items():
            name = f"{family} {id}"
            if known.T_world_tag is not None and name not in self._distrusted and name not in self.gate.named:
                out[name] = replace(known, T_world_tag=T_map_world @ known.T_world_tag)
        return out

    def found(self) -> list[Tag]:
        """All placed tags where they hang in the world (or in the map, where it is not aligned)."""
        out, tags = [], self.map.tags
        for i in np.flatnonzero(tags.placed).tolist():
            sigma_m = math.sqrt(float(np.trace(tags.covariance[i][3:, 3:])) / 3.0)
            T = self.world(tag_world(self.map, i))
            out.append(Tag(*tag_key(self.map, i), float(tags.size_m[i]), T, max(sigma_m, 1e-4)))
        return sorted(out, key=lambda tag: (tag.family, tag.id))

    # -- sightings ----------------------------------------------------------------------------------------------

    def _sized(self, s: TagSighting) -> TagSighting | None:
        """With the size that is known of it, and without the place it claims, which is kept in the book."""
        if len(f"{s.family} {s.id}".encode()) > 80:
            self._tell(s.t_ns, s.name[:20], "refused", "its name is too long for a map")
            return None
        known, lie = self.book.known(s)
        if lie:
            self._tell(s.t_ns, s.name, "contradicts", lie)
            return None
        size_m = known.size_m if known is not None else self.config.default_size_m
        if size_m <= 0.0:
            self._tell(s.t_ns, s.name, "unsized", "its size is not known; add it to the anchors")
            return None
        return replace(s, size_m=size_m, T_world_tag=None)

    def _expect(self, s: TagSighting) -> None:
        """Enter a tag that is seen for the first time: where its survey puts it, if the map is aligned."""
        assert s.size_m is not None
        row = find_tag(self.map, s.name)
        if row < 0:
            row = self.map.tags.append(1, name=np.array([s.name.encode()]), size_m=s.size_m, R=np.eye(3))
        self.gate.tags[s.family, s.id] = KnownTag(s.family, s.id, s.size_m)
        self._survey(row)

    def _keep(self, tag: int, verdict: Verdict, keyframe: int, T_keyframe_body: SE3, own: bool) -> None:
        s = verdict.sighting
        self.map.tag_views.append(
            1, keyframe=keyframe, tag=tag, R=T_keyframe_body.R, p=T_keyframe_body.t, own=own, t_ns=s.t_ns,
            px=s.corners_px, sigma_px=s.sigma_px, usable=verdict.kind != "contradicts",
        )  # fmt: skip
        self._fresh.add(tag)

    def _apart(self, tag: int, T_map_body: SE3) -> bool:
        """Whether the last view of a tag was from somewhere else."""
        rows = np.flatnonzero(self.map.tag_views.tag == tag)
        if not len(rows):
            return True
        T = pose_of_view(self.map, int(rows[-1])).inverse() @ T_map_body
        return T.exceeds(self.config.apart_m, self.config.apart_deg)

    # -- places -------------------------------------------------------------------------------------------------

    def _map_fresh(self, t_ns: int) -> None:
        """Find the place of every tag that has new views; a surveyed one of an aligned map has its own."""
        for tag in sorted(self._fresh):
            if self.map.tags.surveyed[tag]:
                continue
            found = self._by_views(tag)
            if isinstance(found, MappedTag):
                self._place(tag, found.T_world_tag, found.covariance)
            elif "agree" in found.why and self._disagree(tag):
                self._tell(t_ns, tag_name(self.map, tag), "contradicts", found.why)
        self._fresh.clear()

    def _disagree(self, tag: int) -> bool:
        """Whether views of one visit do: between two visits the map may have to be bent."""
        views = views_of(self.map, tag, self.config.max_views, False)
        last_ns = max((v.sighting.t_ns for v in views), default=0)
        views = [v for v in views if last_ns - v.sighting.t_ns < VISIT_NS]
        found = map_tag(views, float(self.map.tags.size_m[tag]), self.spec.camera, self.config.survey)
        return len(views) >= TELLING_VIEWS and isinstance(found, Unmapped) and "agree" in found.why

    def _by_views(self, tag: int, every: bool = False) -> MappedTag | Unmapped:
        views = views_of(self.map, tag, self.config.max_views, every)
        return map_tag(views, float(self.map.tags.size_m[tag]), self.spec.camera, self.config.survey)

    def _place(self, tag: int, T_map_tag: SE3, covariance: Array) -> None:
        tags = self.map.tags
        tags.R[tag], tags.p[tag], tags.covariance[tag], tags.placed[tag] = T_map_tag.R, T_map_tag.t, covariance, True
        family, id = tag_key(self.map, tag)
        self.gate.tags[family, id] = KnownTag(
            family, id, float(tags.size_m[tag]), T_map_tag, covariance, bool(tags.surveyed[tag])
        )  # fmt: skip

    # -- the world ----------------------------------------------------------------------------------------------

    def _align(self, t_ns: int) -> None:
        """Find T_world_map by the surveyed tags that were mapped: as that one says with which most others agree.

        An alignment that rests on one tag is given up when two others agree on another one. Tags that do not agree are
        named, and from then on are tags of unknown place.
        """
        if self.T_world_map is not None and not self._doubt:
            return
        self._doubt = False
        known = [i for i in range(len(self.map.tags)) if self._surveyed(i) is not None]
        found = {i: T for i in known if (T := self._mapped(i)) is not None}
        spread = {i: float(np.trace(self.map.tags.covariance[i][3:, 3:])) for i in found}
        best = consensus(found, {i: self._survey_of(i) for i in found}, spread, self.upright)
        if best is None:
            return
        if len(best.agreeing) < 2 and (len(found) > 1 or self.T_world_map is not None):
            if len(found) > 1:
                names = ", ".join(tag_name(self.map, i) for i in found)
                self._tell(t_ns, names, "contradicts", "no two of them agree on where the map is")
            return
        held = {find_tag(self.map, name) for name in self._alignment}
        if self.T_world_map is None or not held & set(best.agreeing):
            self.T_world_map = best.T_world_map
            self.emit(t_ns, "aligned", tag=tag_name(self.map, best.by), agreeing=len(best.agreeing))
        self._alignment = [tag_name(self.map, i) for i in best.agreeing]
        for i in known:  # those that do not agree may come to: the gate will say
            self.map.tag_views.usable[self.map.tag_views.tag == i] = i in best.agreeing
        for i in sorted(set(found) - set(best.agreeing)) if len(best.agreeing) > 1 else ():
            self._distrust(t_ns, i, found[i], off_m(self.T_world_map @ found[i], self._survey_of(i)))
        for i in known:
            self._survey(i)

    def _disputable(self, tag: int) -> bool:
        """Whether a tag that contradicts may be right: where the map lies in the world hangs on a single other one."""
        return len(self._alignment) == 1 and self._surveyed(tag) is not None

    def _named(self, t_ns: int, kind: str, tag: str, verdict: str, why: str) -> None:
        """The gate found a tag wrong; or the only one that it was judged by."""
        if self._disputable(find_tag(self.map, tag)):
            why = f"{why}; or {self._alignment[0]} is not where it was surveyed"
            tag = f"{tag}, {self._alignment[0]}"
        self._tell(t_ns, tag, verdict, why)

    def _mapped(self, tag: int) -> SE3 | None:
        """Where a tag hangs by its views alone, whatever its survey says."""
        if not self.map.tags.surveyed[tag]:
            return tag_world(self.map, tag) if self.map.tags.placed[tag] else None
        found = self._by_views(tag, every=True)
        return found.T_world_tag if isinstance(found, MappedTag) else None

    def _distrust(self, t_ns: int, tag: int, T_map_tag: SE3, off_m: float) -> None:
        """Forget the survey of a tag that hangs elsewhere."""
        name = tag_name(self.map, tag)
        self._distrusted.add(name)
        self.map.tag_views.usable[self.map.tag_views.tag == tag] = True  # they show where it hangs, and that is all
        self.map.tags.surveyed[tag] = False
        self._place(tag, T_map_tag, self.map.tags.covariance[tag].copy())
        self._tell(t_ns, name, "contradicts", f"it hangs {off_m:.2f} m from where it was surveyed: moved or misread")

    def _survey_of(self, tag: int) -> SE3:
        known = self._surveyed(tag)
        assert known is not None
        assert known.T_world_tag is not None
        return known.T_world_tag

    def _surveyed(self, row: int) -> KnownTag | None:
        name = tag_name(self.map, row)
        known = self.book.tags.get(tag_key(self.map, row))
        usable = known is not None and known.T_world_tag is not None and name not in self._distrusted
        return known if usable else None

    def _survey(self, row: int) -> None:
        """Put a surveyed tag where its survey has it, once the map is aligned."""
        survey = self._surveyed(row)
        if self.T_world_map is None or survey is None or survey.T_world_tag is None:
            return
        T_map_tag = self.T_world_map.inverse() @ survey.T_world_tag
        anchors = [tag_world(self.map, i) for name in self._alignment if (i := find_tag(self.map, name)) >= 0]
        self.map.tags.surveyed[row] = True
        self._place(row, T_map_tag, survey.covariance + looseness(anchors, T_map_tag))

    # -- corrections --------------------------------------------------------------------------------------------

    def _correct(self, t_ns: int, worst_px: float, stop: Callable[[], bool] | None) -> None:
        iterations = 0 if self.upright else self.config.iterations  # the last adjustment has the IMU, this one has not
        moved_m = correct_by_tags(self.map, self.orb, self.sigma_px, iterations, stop)
        with self.map.lock:
            seen = np.unique(self.map.tag_views.tag[self.map.tag_views.usable])
            self._alignment = [tag_name(self.map, int(i)) for i in seen if self.map.tags.surveyed[i]] or self._alignment
            self._fresh |= {int(i) for i in seen}
            self._map_fresh(t_ns)
            for i in range(len(self.map.tags)):
                self._survey(i)
        self.emit(t_ns, "tags", corrected=True, misfit_px=worst_px, moved_m=moved_m, surveyed=len(self._alignment))

    # -- small things -------------------------------------------------------------------------------------------

    def _recall(self) -> None:
        """What a loaded map knows of tags; one with a surveyed tag is in the world already."""
        for i in range(len(self.map.tags)):
            family, id = tag_key(self.map, i)
            size_m, placed = float(self.map.tags.size_m[i]), bool(self.map.tags.placed[i])
            self.gate.tags[family, id] = KnownTag(
                family, id, size_m, tag_world(self.map, i) if placed else None, self.map.tags.covariance[i].copy(),
                bool(self.map.tags.surveyed[i]),
            )  # fmt: skip
        if np.any(self.map.tags.surveyed):
            self.T_world_map = SE3.identity()
            self._alignment = [tag_name(self.map, int(i)) for i in np.flatnonzero(self.map.tags.surveyed)]

    def _tell(self, t_ns: int, name: str, verdict: str, why: str) -> None:
        """Each complaint once."""
        if f"{name} {verdict}" not in self._told:
            self._told.add(f"{name} {verdict}")
            self.emit(t_ns, "tag", tag=name, verdict=verdict, why=why)
