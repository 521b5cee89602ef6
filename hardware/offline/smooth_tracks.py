"""The tracks of a session that is smoothed: recorded ones, else the tracker's on its images; and reobserved landmarks.
Then the rhythms in what they are smoothed to.

Tracks take long to compute, so they are kept as a recording beside the results, with the hash of their source.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from typing import TextIO

import numpy as np

from estimation.batch.smoothed import Smoothed
from estimation.errors import InputError
from estimation.observations import Observations
from estimation.pose import SurfacePose, Trajectory
from estimation.rig import Rig
from estimation.se3 import Array
from hardware.files.session import Session
from hardware.offline.track import tracker
from hardware.process.clock import WallClock
from hardware.process.progress import Progress
from hardware.recording.mcap_file import AttachedFile, ChunkMessages, walk
from hardware.recording.recorder import Recorder
from hardware.recording.session_reader import read_observations, read_poses
from perception.frames import mean_stamp
from perception.tracking.reobservation import KnownMotion, ReferencePictures, Reobserver, joined_observations

SOURCE_ATTACHMENT = "made_of.txt"  # name of the attachment with the hash, the recording's first record


def source_hash(path: Path) -> str:
    """The hash that `track_writer` stored in a recording; "" where there is no recording, or no hash in it."""
    with suppress(InputError):  # unreadable: the tracks are computed again
        for part in walk(path):
            if isinstance(part, AttachedFile) and part.name == SOURCE_ATTACHMENT:
                return part.data.decode()
            if isinstance(part, ChunkMessages):
                break
    return ""


def part_path(target: Path) -> Path:
    """The recording while it is written, and what an interruption leaves of it."""
    return target.with_suffix(".part.mcap")


@contextmanager
def track_writer(target: Path, rig: Rig, contents: str, began: int | None = None) -> Iterator[Recorder]:
    """A recorder for tracks computed from a source of the hash `contents`; the file gets its name once it is whole."""
    partial_file = part_path(target)
    with Recorder(partial_file, rig, overwrite=True, began=began) as recorder:
        recorder.attach(SOURCE_ATTACHMENT, contents.encode())
        yield recorder
    os.replace(partial_file, target)


TRACKS_FILE = "tracks.mcap"


@dataclass(frozen=True, slots=True, eq=False)
class SessionTracks:
    """The results of a causal run."""

    observations: tuple[Observations, ...]  # of each frame set, in order of stamp
    poses: tuple[SurfacePose, ...]  # in order of stamp

    @property
    def start(self) -> Trajectory | None:
        """The poses that were measured; None where there are none."""
        measured = [pose for pose in self.poses if pose.state.measured]
        if not measured:
            return None
        stamps = np.array([pose.stamp for pose in measured])
        return Trajectory(stamps, np.stack([pose.base_from_surface for pose in measured]), exact=False)


def tracks_of(session: Session, out: Path, contents: str, stream: TextIO | None = None) -> SessionTracks:
    """The session's tracks. Where it has none, its images are tracked first, into tracks.mcap in the folder `out`.

    contents: the session's hash; tracks.mcap of another one is replaced. stream: for progress, by default stderr.
    """
    if session.path.is_file():
        recorded = read_tracks(session.path)
        if any(map(len, recorded.observations)):
            return recorded
    if source_hash(out / TRACKS_FILE) != contents:
        _track(session, out / TRACKS_FILE, contents, stream)
    tracks = read_tracks(out / TRACKS_FILE)
    if not any(map(len, tracks.observations)):
        raise InputError(session.path, "tracks", "none in its images", "a surface that the tracker finds")
    return tracks


def read_tracks(path: Path) -> SessionTracks:
    """The tracks in a recording, each stamp once: a run interrupted while it wrote may have stored a chunk twice."""
    observations = {record.stamp: record for record in read_observations(path)}
    poses = {pose.stamp: pose for pose in read_poses(path) if np.isfinite(pose.base_from_surface).all()}
    return SessionTracks(
        tuple(observations[stamp] for stamp in sorted(observations)), tuple(poses[stamp] for stamp in sorted(poses))
    )


def _track(session: Session, target: Path, contents: str, stream: TextIO | None) -> None:
    clock = WallClock()
    with (
        tracker(session.rig, session.roi, session.surface, clock.now) as step,
        track_writer(target, session.rig, contents, session.began) as recorder,
        Progress("track", "frame sets", clock.now, stream) as progress,
    ):
        for done, frames in enumerate(session.frame_sets(), 1):
            pose = step(frames)
            recorder.write(step.last.observations)
            recorder.write(pose)
            step.idle()
            progress(done, len(session))


RELINKED_FILE = "relinked.mcap"
STAMP_TOLERANCE_S = 1e-6  # s


@dataclass(frozen=True, slots=True, eq=False)
class ReobservedTracks:
    """The session's tracks with the landmarks that were found again in its images."""

    tracks: SessionTracks
    looks: int = 0  # number of added observations
    early: int = 0  # those of them that precede their landmark's first track
    sets: int = 0  # frame sets that had no track before
    trouble: str = ""  # why not all images were searched, "" if they were

    @property
    def text(self) -> str:
        """A sentence to follow others, "" where nothing was found."""
        sentence = f" {self.looks} looks at landmarks were found besides the tracks'" if self.looks else ""
        parts = [(self.early, "of landmarks that joined the map later"), (self.sets, "frame sets had none")]
        details = ", ".join(f"{count} {what}" for count, what in parts if count)
        trouble = f" Images were not searched to their end: {self.trouble}." if self.trouble else ""
        return f"{sentence}{': ' if sentence and details else ''}{details}{'.' if sentence else ''}{trouble}"

    @property
    def figures(self) -> dict[str, int]:
        """For summary.json."""
        return {"looks_found": self.looks, "looks_before_joining": self.early, "frame_sets_found": self.sets}


def reobserve(
    session: Session, tracks: SessionTracks, smoothed: Smoothed, out: Path, contents: str, stream: TextIO | None = None
) -> ReobservedTracks:
    """The session's tracks, and observations of its landmarks in images that show one without a track.

    They are kept in relinked.mcap in the folder `out`. smoothed: by these tracks. contents: hash of the session and of
    how it was smoothed; a file of another one is replaced. stream: for progress, by default stderr.
    """
    file, trouble = out / RELINKED_FILE, ""
    if source_hash(file) != contents:
        try:
            with track_writer(file, session.rig, contents) as recorder:
                for record in _search_images(session, tracks, smoothed, stream):
                    recorder.write(record)
        except InputError as damage:  # the tracks do not need the images
            file, trouble = part_path(file), str(damage)
    return replace(with_looks(tracks, read_tracks(file).observations), trouble=trouble)


def with_looks(tracks: SessionTracks, added: Iterable[Observations]) -> ReobservedTracks:
    """The tracks together with more observations, in order of stamp."""
    by_stamp = {record.stamp: record for record in tracks.observations}
    first_stamps: dict[int, float] = {}
    for record in tracks.observations:
        for track in np.unique(record.track).tolist():
            first_stamps.setdefault(track, record.stamp)
    looks = early = sets = 0
    for record in added:
        existing = by_stamp.get(record.stamp)
        by_stamp[record.stamp] = record if existing is None else joined_observations(existing, record)
        looks += len(record)
        early += sum(record.stamp < first_stamps[track] for track in record.track.tolist())
        sets += existing is None or not len(existing)
    observations = tuple(by_stamp[stamp] for stamp in sorted(by_stamp))
    return ReobservedTracks(replace(tracks, observations=observations), looks, early, sets)


def _search_images(
    session: Session, tracks: SessionTracks, smoothed: Smoothed, stream: TextIO | None
) -> Iterable[Observations]:
    motion = KnownMotion(session.rig, smoothed, tracks.observations)
    references = ReferencePictures(motion)
    stamps = np.array([mean_stamp(refs) for refs in session.sets])
    needed = np.abs(stamps[:, None] - references.stamps).min(1, initial=np.inf) < STAMP_TOLERANCE_S
    subset = replace(session, sets=tuple(refs for refs, mine in zip(session.sets, needed, strict=True) if mine))
    total = len(subset) + len(session)
    with Progress("relink", "frame sets", WallClock().now, stream) as progress:
        for done, frames in enumerate(subset.frame_sets(), 1):
            references.cut(frames)
            progress(done, total)
        matcher = references.matcher()
        if matcher is None:
            return
        relinker, looks = Reobserver(motion, *matcher), list[Observations]()
        try:
            for done, frames in enumerate(session.frame_sets(), 1 + len(subset)):
                looks += relinker(frames)
                progress(done, total)
        finally:
            yield from map(relinker.as_tracks, looks)


BREATHING_BAND_HZ = (0.1, 0.7)  # Hz: 6 to 42 breaths a minute
PULSE_BAND_HZ = (0.75, 3.0)  # Hz: 45 to 180 beats a minute
WINDOW_S = {"breathing": 20.0, "pulse": 15.0}  # s of each of the windows that have to agree
MIN_WINDOWS = {"breathing": 2, "pulse": 3}
MIN_SECONDS = {"breathing": 24.0, "pulse": 45.0}  # s: of a shorter recording none is reported
MIN_CYCLES = 3  # of a rhythm in each window: slower ones are not told from drift
HARMONICS = 3  # of a rhythm that are fitted; of two alone, three times a pulse's rate fits as well as its own
RATE_STEPS = 160  # candidate rates of a band, evenly apart in their logarithm
MIN_EXPLAINED = 0.6  # share of the motion in each window that breathing has to explain
MAX_SPREAD = {"breathing": 0.25, "pulse": 0.05}  # of the windows' rates, relative: more is no rhythm, but chance
# least mean over the windows of the log ratio, summed over the harmonics, of a pulse's power to that between them:
MIN_COMB = 0.7  # with pulses of 0.1 mm beside 8 mm of breathing it is 1.0 and more, without one 0.2 at most
MIN_WINDOW_SPREAD = 0.01  # of the rate of a window, relative: beats differ by 5 %, and a window holds some fifteen
CLAIM_QUANTILE = 0.975  # quantile of Student's distribution: with few windows their spread is itself not known well
MULTIPLES, MULTIPLE_BINS = 12, 1.5  # of an even breathing's rate at which no pulse can be told from it, and how near


@dataclass(frozen=True, slots=True)
class Rhythm:
    """A rate of the motion with its uncertainty. why: none is found, "" where one is."""

    rate: float  # Hz, NaN where none is found
    claim: float  # Hz, half width of the 95 % interval
    why: str = ""

    @property
    def per_minute(self) -> str:
        """In words."""
        digits = 0 if 60 * self.claim >= 1 else 1
        return f"{60 * self.rate:.{digits}f} ± {60 * self.claim:.{digits}f}"

    def words(self, name: str) -> str:
        """A sentence about it. name: what it is."""
        return f"No {name} found: {self.why}." if self.why else f"{name.capitalize()}: {self.per_minute} a minute."


def breathing_rhythm(times: Array, along: Array) -> Rhythm:
    """The breathing in a motion (N,) mm at even times (N,), s: a harmonic model with a trend, window by window."""
    windows = _windows(times, "breathing")
    if not windows:
        return Rhythm(nan, nan, "the recording is too short")
    low = max(BREATHING_BAND_HZ[0], MIN_CYCLES / (times[windows[0]][-1] - times[windows[0]][0]))
    rates = np.geomspace(low, BREATHING_BAND_HZ[1], RATE_STEPS)
    window_rates = []
    for window in windows:
        explained = np.array([_explained_share(times[window], along[window, None], rate) for rate in rates])
        index = int(explained.argmax())
        if explained[index] < MIN_EXPLAINED or index == 0:  # at the slowest rate a drift fits best
            return Rhythm(nan, nan, "the motion has no regular rhythm")
        window_rates.append(float(rates[index]))
    return _common_rate(window_rates, "breathing")


def pulse_rhythm(times: Array, positions: Array, breathing: Rhythm) -> Rhythm:
    """The pulse in positions (N, 3) mm at even times (N,), s.

    A pulse is a comb in the spectrum of the acceleration, in which breathing, however large, has little power beyond
    its first harmonics: power on the comb is compared with that between its teeth, in multitaper spectra of windows.
    """
    windows = _windows(times, "pulse")
    if not windows:
        return Rhythm(nan, nan, "the recording is too short")
    rates = np.geomspace(*PULSE_BAND_HZ, RATE_STEPS)
    scores = np.array([_comb_scores(times[window], positions[window], rates) for window in windows])  # (W, R)
    mean = scores.mean(axis=0)
    if not mean.max() > MIN_COMB:
        return Rhythm(nan, nan, "what there is, chance explains")
    rate = float(rates[mean.argmax()])
    candidates = rate * np.linspace(0.94, 1.06, 61)
    window_rates = []
    for window in windows:
        acceleration = np.gradient(np.gradient(positions[window], times[window], axis=0), times[window], axis=0)
        shares = [_explained_share(times[window], acceleration, candidate) for candidate in candidates]
        window_rates.append(float(candidates[np.argmax(shares)]))
    pulse, resolution = _common_rate(window_rates, "pulse"), MULTIPLE_BINS / float(times[-1] - times[0])
    for k in range(2, MULTIPLES + 1):
        blurred = k * breathing.claim > resolution  # breaths differ: no spectral line at this multiple
        if abs(pulse.rate - k * breathing.rate) < resolution and not blurred:
            return Rhythm(nan, nan, f"{k} times the breathing's rate cannot be told from the breathing")
    return pulse


def _windows(times: Array, name: str) -> list[slice]:
    """Parts of the recording that have to agree on a rhythm; none of one that is too short."""
    seconds = len(times) * float(times[1] - times[0]) if len(times) > 1 else 0.0
    if seconds < MIN_SECONDS[name]:
        return []
    count = max(int(seconds / WINDOW_S[name]), MIN_WINDOWS[name])
    size = len(times) // count
    return [slice(k * size, (k + 1) * size) for k in range(count)]


def _common_rate(rates: Sequence[float], name: str) -> Rhythm:
    """The mean rate of the windows with its uncertainty; none where they disagree."""
    mean, spread = float(np.mean(rates)), float(np.std(rates, ddof=1))
    if spread > MAX_SPREAD[name] * mean:
        return Rhythm(nan, nan, "its parts do not agree")
    from scipy.stats import t as student

    error = max(spread, MIN_WINDOW_SPREAD * mean) / len(rates) ** 0.5
    return Rhythm(mean, float(student.ppf(CLAIM_QUANTILE, len(rates) - 1)) * error)


def _explained_share(times: Array, values: Array, rate: float) -> float:
    """Share of values (N, D) that a trend and the harmonics of a rate, Hz, explain beyond the trend."""
    phase = 2 * np.pi * rate * (times - times[0])
    waves = [wave(k * phase) for k in range(1, HARMONICS + 1) for wave in (np.cos, np.sin)]
    trend = np.vander((times - times.mean()) / np.ptp(times), 3)
    detrended = values - trend @ np.linalg.lstsq(trend, values, rcond=None)[0]
    design = np.column_stack([*waves, trend])
    residual = detrended - design @ np.linalg.lstsq(design, detrended, rcond=None)[0]
    return 1.0 - float((residual**2).sum()) / max(float((detrended**2).sum()), 1e-30)


def _comb_scores(times: Array, positions: Array, rates: Array) -> Array:
    """(R,) of each rate: log ratio of the acceleration's power on its harmonics to that midway between them, summed."""
    from scipy.signal.windows import dpss

    step = float(times[1] - times[0])
    accel = np.diff(positions, 2, axis=0) / step**2
    tapers = dpss(len(accel), 3, 5)  # five windows of a bandwidth of three bins
    size = 4 * len(accel)
    power = (np.abs(np.fft.rfft(tapers[:, :, None] * (accel - accel.mean(0)), size, axis=1)) ** 2).mean(0).sum(-1)
    hertz, total = np.fft.rfftfreq(size, step), np.concatenate([[0.0], np.cumsum(power)])

    def between(low: Array, high: Array) -> Array:
        """Mean power of the bins from low to high (R,), Hz."""
        first, last = np.searchsorted(hertz, low), np.maximum(np.searchsorted(hertz, high, "right"), 1)
        return np.asarray((total[last] - total[np.minimum(first, last - 1)]) / np.maximum(last - first, 1))

    score = np.zeros(len(rates))
    for k in range(1, HARMONICS + 1):
        tooth, gap = np.maximum(3 / (len(accel) * step), 0.02 * k * rates), 0.5 * rates
        wide = np.maximum(tooth, 0.125 * rates)
        background = 0.5 * (
            between(k * rates - gap - wide, k * rates - gap + wide)
            + between(k * rates + gap - wide, k * rates + gap + wide)
        )
        score += np.log(between(k * rates - tooth, k * rates + tooth) + 1e-30) - np.log(background + 1e-30)
    return score
