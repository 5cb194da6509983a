"""A network camera: an RTSP server with one H.264 stream for each eye, by GStreamer's own server library.

    python rtsp_server.py PORT 'LAUNCH STRING OF BOTH EYES'

Streams are rtsp://127.0.0.1:PORT/left and /right.
"""

import sys
from ctypes import CDLL, c_char_p, c_void_p

LIBRARY = "libgstrtspserver-1.0.so.0"
CODED = "openh264enc gop-size=15 ! h264parse ! rtph264pay name=pay0 pt=96 config-interval=1"


def main() -> None:
    port, camera = sys.argv[1:]
    gst, glib, rtsp = (CDLL(name) for name in ("libgstreamer-1.0.so.0", "libglib-2.0.so.0", LIBRARY))

    def call(library: CDLL, name: str, *arguments: int | bytes | None) -> int:
        function = getattr(library, name)
        function.restype = c_void_p
        function.argtypes = [c_char_p if isinstance(one, bytes) else c_void_p for one in arguments]
        return function(*arguments) or 0

    call(gst, "gst_init", None, None)
    server = call(rtsp, "gst_rtsp_server_new")
    call(rtsp, "gst_rtsp_server_set_address", server, b"127.0.0.1")
    call(rtsp, "gst_rtsp_server_set_service", server, port.encode())
    mounts = call(rtsp, "gst_rtsp_server_get_mount_points", server)
    for eye in (b"/left", b"/right"):
        factory = call(rtsp, "gst_rtsp_media_factory_new")
        call(rtsp, "gst_rtsp_media_factory_set_launch", factory, f"( {camera} ! {CODED} )".encode())
        call(rtsp, "gst_rtsp_mount_points_add_factory", mounts, eye, factory)
    if not call(rtsp, "gst_rtsp_server_attach", server, None):
        sys.exit(f"cannot serve at port {port}")
    print("sending", flush=True)
    call(glib, "g_main_loop_run", call(glib, "g_main_loop_new", None, 0))


if __name__ == "__main__":
    main()
