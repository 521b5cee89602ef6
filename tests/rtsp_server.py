"""GStreamer's RTSP server with one camera, run by the system's Python: rtsp://127.0.0.1:PORT/camera.

Each picture, 320x240, shows the instant at which it was taken, by the machine's monotonic clock in ms, as 32 bars,
white for 1, the highest bit first. It prints "ready" once it listens.
"""

from __future__ import annotations

import sys
import threading
import time

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402

SIZE, FPS = (320, 240), 25
PIPELINE = (
    "( appsrc name=source is-live=true do-timestamp=true format=time "
    f"caps=video/x-raw,format=GRAY8,width={SIZE[0]},height={SIZE[1]},framerate={FPS}/1 "
    "! videoconvert ! video/x-raw,format=I420 "
    "! x264enc tune=zerolatency speed-preset=ultrafast key-int-max=25 bitrate=2000 "
    "! rtph264pay name=pay0 pt=96 )"
)


def picture(instant: int) -> bytes:
    """A picture that shows an instant, ms."""
    bars = [235 if instant >> (31 - i) & 1 else 16 for i in range(32)]
    row = b"".join(bytes([bar]) * (SIZE[0] // 32) for bar in bars)
    return row * SIZE[1]


def feed(source: Gst.Element) -> None:
    """Push a picture at each beat until nobody takes it."""
    due = time.monotonic()
    while True:
        due += 1 / FPS
        time.sleep(max(0.0, due - time.monotonic()))
        shown = Gst.Buffer.new_wrapped(picture(round(1000 * time.monotonic())))
        if source.emit("push-buffer", shown) != Gst.FlowReturn.OK:
            return


def configure(_: object, media: GstRtspServer.RTSPMedia) -> None:
    """Feed the camera of a connection."""
    source = media.get_element().get_child_by_name("source")
    threading.Thread(target=feed, args=(source,), daemon=True).start()


def main() -> None:
    Gst.init(None)
    for name in ("appsrc", "x264enc", "rtph264pay"):
        if Gst.ElementFactory.find(name) is None:
            sys.exit(f"GStreamer has no {name}")
    server, factory = GstRtspServer.RTSPServer(), GstRtspServer.RTSPMediaFactory()
    server.set_address("127.0.0.1")
    server.set_service(sys.argv[1])
    factory.set_launch(PIPELINE)
    factory.set_shared(True)
    factory.connect("media-configure", configure)
    server.get_mount_points().add_factory("/camera", factory)
    if server.attach(None) == 0:
        sys.exit("the port is taken")
    print("ready", flush=True)
    GLib.MainLoop().run()


if __name__ == "__main__":
    main()
