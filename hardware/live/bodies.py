"""What the processes of a run do, as functions that load nothing before they are called in their process."""

from __future__ import annotations

from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path as File

from hardware.live.frame_source import FrameRing
from hardware.live.injected import Begun
from hardware.live.place import Place
from hardware.live.prepared import Prepared
from hardware.live.records import Handed, LiveMotionReport, RecorderReport, TrackingReport
from hardware.operator.link import OperatorLink
from hardware.process.shared_latest import Newest


def show(prepared: Prepared, ring: FrameRing, words: Connection, begun: Begun) -> None:
    """Show a recorded session, as cameras would."""
    from hardware.live.session_player import FeedPlan, feed_process

    feed_process(FeedPlan(prepared.session, prepared.again, prepared.faults, begun), ring, words)


def record(prepared: Prepared, senders: Sequence[Connection], reports: Newest[RecorderReport]) -> None:
    """Record what the senders give."""
    from hardware.live.recorder_process import RecorderPlan, recorder_process

    settings = prepared.settings
    assert settings.record is not None
    plan = RecorderPlan(settings.record, settings.jpeg_quality or None, overwrite=True, cores=settings.cores_recorder)
    recorder_process(plan, senders, reports)


def track(
    prepared: Prepared,
    ring: FrameRing,
    words: Connection,
    poses: Newest[Handed],
    reports: Newest[TrackingReport],
    motion: Newest[LiveMotionReport],
    link: OperatorLink,
    sender: Connection,
    lifeline: Connection,
) -> None:
    """Follow the surface."""
    from hardware.live.tracking_process import TrackingLines, TrackingPlan, tracking_process

    found, settings = prepared.found, prepared.settings
    plan = TrackingPlan(
        session=prepared.session,
        truth=prepared.again,
        sees_arm=prepared.live,
        profile=prepared.task.profile,
        earlier=None if found is None else found.map,
        until=0.0 if found is None else found.until,
        surface_from_path=None if found is None else found.surface_from_path,
        cores=settings.cores_tracking,
    )
    tracking_process(plan, TrackingLines(ring, words, poses, reports, motion, link, sender, lifeline))


def move(
    prepared: Prepared,
    url: str,
    place: Place,
    poses: Newest[Handed],
    reports: Newest[LiveMotionReport],
    orders: Connection,
    link: OperatorLink,
    trouble: Newest[str],
    sender: Connection,
) -> None:
    """Plan the motion, and send it to the arm at `url`."""
    from hardware.link_settings import LinkSettings
    from hardware.live.motion_process import LiveMotionPlan, live_motion_process

    settings, profile = prepared.settings, prepared.task.profile
    line = LinkSettings(pause_frame=settings.pause_frame)
    plan = LiveMotionPlan(profile, url, prepared.beside.progress, line, settings.real_time, settings.cores_motion)
    live_motion_process(plan, place, poses, reports, orders, link.requests, trouble, sender)


def move_virtually(prepared: Prepared, link: File, lifeline: Connection) -> None:
    """Be the arm."""
    from hardware.live.virtual_arm import VirtualArmPlan, virtual_arm_process

    settings = prepared.settings
    executed = prepared.beside.executed
    plan = VirtualArmPlan(link, executed, prepared.task.profile, prepared.virtual, settings.real_time)
    virtual_arm_process(plan, lifeline)
