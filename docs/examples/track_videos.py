"""Track a folder of videos, and print where the surface is: python docs/examples/track_videos.py SESSION

A session folder holds rig.toml, frames.csv and a video a camera (docs/conventions.md).
"""

from __future__ import annotations

from hardware.cli.parser import run_script
from hardware.offline.track import step_by
from hardware.recording.session_reader import open_session
from perception.tracking import MAP_METHOD


def main(folder: str) -> None:
    """Print stamp, state, place and its uncertainty for each frame set."""
    session = open_session(folder)
    with step_by(MAP_METHOD, session.rig, session.roi, session.surface) as step:
        for frames in session.frame_sets():
            pose = step(frames)
            x, y, z = pose.base_from_surface[:3, 3]
            sigma = max(pose.covariance[i, i] for i in (3, 4, 5)) ** 0.5  # mm
            print(f"{pose.stamp:9.3f} s  {pose.state.value:<12} {x:9.3f} {y:9.3f} {z:9.3f} mm  +- {sigma:.3f}")
            step.idle()  # work that no pose waits for: the map grows here


if __name__ == "__main__":
    run_script(main, __doc__)
